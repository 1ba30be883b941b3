"""A velocity field as one C99 header that needs nothing but <math.h>: no allocation, bounded work per call."""

from __future__ import annotations

import os
import re
from string import Template
from typing import Any

import numpy as np
import torch

from ..files import atomic_write
from ..kernels.adjoint import NEGLIGIBLE
from ..kernels.translations import BEYOND
from ..tabulated import LINEAR_BELOW, LawKind, LawTable
from ..translations import ROOT_STEPS
from .tables import FieldTables, VelocityField, describe, tables_of


def write(ds: VelocityField, path: str | os.PathLike[str], *, name: str) -> None:
    """Write the velocity of a system as it is now as a C header with two functions, for double and for float.

    ``NAME_velocity`` agrees with this package to rounding. ``NAME_velocityf`` computes in float alone, for processors
    without double; it is off by as much as the velocity changes when the position is rounded to float: 1e-7 to 1e-4 of
    the largest speed as the field is steep, more where ψ nearly folds. Both take at most eight steps a layer, work on
    the stack, and keep nothing between calls, so that threads may share them. ``velocity`` may be ``y`` itself. A
    position that is not finite has a velocity of NaN, except under ``-ffast-math``.

    Args:
        ds: a system of locally weighted translations with the dynamics of this package, fitted or not, in any dtype
            and on any device.
        path: the file, by custom ``*.h``; it is there whole or not at all.
        name: what the names in it begin with, NAME above: letters, digits and underscores after a first letter.

    Raises:
        ValueError: for a system that cannot be written so, naming what is missing, or another name.

    Example: after ``c.write(ds, "reach.h", name="reach")`` this program, linked with ``-lm``, ends at the goal::

        #include <stdio.h>
        #include "reach.h"

        int main(void) {
            double y[reach_DIM] = {0}, velocity[reach_DIM];
            for (int step = 0; step < 10000; step++) {
                reach_velocity(y, velocity);
                for (int d = 0; d < reach_DIM; d++) y[d] += 0.001 * velocity[d];
            }
            for (int d = 0; d < reach_DIM; d++) printf("%.9f %.9f\\n", y[d], reach_goal[d]);
            return 0;
        }
    """
    if not (isinstance(name, str) and re.fullmatch(r"[A-Za-z]\w*", name, re.ASCII)):
        raise ValueError(f"name: expected letters, digits and underscores after a first letter, got {name!r}")
    tables = tables_of(ds)
    text = _FRAME.substitute(
        NAME=name,
        about="\n".join(f" * {key}: {value}" for key, value in describe(ds).items()),
        dim=ds.dim,
        count=len(tables.layers),
        goal=_braces(ds.attractor.detach().to("cpu", torch.float64).numpy(), ""),
        in_double=_field(tables, name, "double"),
        in_float=_field(tables, name, "float"),
    )
    with atomic_write(path) as file:
        file.write(text.encode("ascii"))


def _field(tables: FieldTables, name: str, real: str) -> str:
    """Tables and functions of one precision."""
    suffix, limits = {"double": ("", "DBL"), "float": ("f", "FLT")}[real]
    words: dict[str, Any] = {"NAME": name, "real": real, "f": suffix, "LIMITS": limits}
    attractor, axis, (length, *_) = tables.goal
    numbers = {
        "layers": tables.layers,
        "attractor": attractor,
        "axis": axis,
        "length": length,
        "beyond": np.array(BEYOND),
        "negligible": np.array(NEGLIGIBLE),
    }
    text = {key: _braces(value, suffix) for key, value in numbers.items()}
    laws = "".join(_law(law, key, words) for key, law in (("along", tables.along), ("across", tables.across)))
    return _FIELD.substitute(words, **text, laws=laws, steps=ROOT_STEPS)


def _law(law: LawTable, key: str, words: dict[str, Any]) -> str:
    """The function h(s)/s."""
    if law.kind is LawKind.EIGENMAP:
        numbers = {"tail": np.array(LINEAR_BELOW), "omega": law.speeds[0]}
        template = _EIGENMAP
    else:
        numbers = {"pieces": law.pieces()}
        template = _KNOTTED
    text = {k: _braces(value, words["f"]) for k, value in numbers.items()}
    return template.substitute(words, **text, key=key, count=law.pieces().shape[1])


def _braces(numbers: Any, suffix: str) -> str:
    """An array as C writes it: the shortest digits that give each number back."""
    if np.ndim(numbers):
        ends = (",\n    " if np.ndim(numbers) > 1 else ", ").join(_braces(part, suffix) for part in numbers)
        return f"{{{ends}}}"
    with np.errstate(over="ignore"):
        value = np.float32(numbers) if suffix else np.float64(numbers)
    if not np.isfinite(value):
        raise ValueError(f"ds: expected parameters that a float can hold, got {numbers:g}")
    return f"{value!s}{suffix}"


_FRAME = Template("""\
/* The velocity field of a stable dynamical system, written by latentds.
$about
 */
#ifndef ${NAME}_VELOCITY_H
#define ${NAME}_VELOCITY_H

#include <float.h>
#include <math.h>

#define ${NAME}_DIM $dim
#define ${NAME}_LAYERS $count

static const double ${NAME}_goal[${NAME}_DIM] = $goal;

$in_double
$in_float
#endif
""")

_FIELD = Template("""\
/* Of each layer: c, v, rho^2, rho^2 |v|^2. */
static const $real ${NAME}_layers$f[${NAME}_LAYERS][2 * ${NAME}_DIM + 2] = $layers;
static const $real ${NAME}_latent_goal$f[${NAME}_DIM] = $attractor;
static const $real ${NAME}_axis$f[${NAME}_DIM] = $axis;

$laws
/* The s in [0, 1] with s = exp(-(a s^2 - 2 b s + c)), by Laguerre's method. */
static inline $real ${NAME}_root$f($real a, $real b, $real c) {
    $real s = (b - sqrt$f(0.5$f * a)) / (a > ${LIMITS}_MIN ? a : ${LIMITS}_MIN);
    s = s < 0.0$f ? 0.0$f : s > 1.0$f ? 1.0$f : s;
    for (int step = 0; step < $steps; step++) {
        const $real g = b - a * s, exponent = s * (g + b) - c;
        const $real k = exp$f(exponent > 0.0$f ? 0.0$f : exponent), gap = s - k;
        if (fabs$f(gap) <= 2.0$f * ${LIMITS}_EPSILON) break;
        const $real p = g * k, slope = 1.0$f - 2.0$f * p;
        const $real flat = slope + 2.0$f * sqrt$f(fabs$f(slope * slope - 3.0$f * gap * (a * k - 2.0$f * g * p)));
        s -= 3.0$f * gap / (flat < ${LIMITS}_MIN ? ${LIMITS}_MIN : flat);
        s = s < 0.0$f ? 0.0$f : s > 1.0$f ? 1.0$f : s;
    }
    return s;
}

/* Units of y per second. */
static inline void ${NAME}_velocity$f(const $real y[${NAME}_DIM], $real velocity[${NAME}_DIM]) {
    $real x[${NAME}_DIM], ahead = 0.0$f, aside = 0.0$f, not_finite = 0.0$f;
    for (int d = 0; d < ${NAME}_DIM; d++) {
        x[d] = y[d];
        not_finite += 0.0$f * y[d];
    }
    for (int j = ${NAME}_LAYERS - 1; j >= 0; j--) { /* y to the latent point x */
        const $real *const c = ${NAME}_layers$f[j], *const v = c + ${NAME}_DIM, *const squares = v + ${NAME}_DIM;
        $real along = 0.0$f, distance = 0.0$f;
        for (int d = 0; d < ${NAME}_DIM; d++) {
            along += (x[d] - c[d]) * v[d];
            distance += (x[d] - c[d]) * (x[d] - c[d]);
        }
        if (squares[0] * distance > $beyond) continue;
        const $real s = ${NAME}_root$f(squares[1], squares[0] * along, squares[0] * distance);
        for (int d = 0; d < ${NAME}_DIM; d++) x[d] -= s * v[d];
    }
    for (int d = 0; d < ${NAME}_DIM; d++) { /* the latent velocity */
        velocity[d] = (x[d] - ${NAME}_latent_goal$f[d]) / $length;
        ahead += velocity[d] * ${NAME}_axis$f[d];
    }
    for (int d = 0; d < ${NAME}_DIM; d++) {
        velocity[d] -= ahead * ${NAME}_axis$f[d];
        aside += velocity[d] * velocity[d];
    }
    ahead *= ${NAME}_along$f(fabs$f(ahead));
    aside = ${NAME}_across$f(sqrt$f(aside));
    for (int d = 0; d < ${NAME}_DIM; d++)
        velocity[d] = -$length * (ahead * ${NAME}_axis$f[d] + aside * velocity[d]);
    for (int j = 0; j < ${NAME}_LAYERS; j++) { /* and both back again */
        const $real *const c = ${NAME}_layers$f[j], *const v = c + ${NAME}_DIM, *const squares = v + ${NAME}_DIM;
        $real along = 0.0$f, distance = 0.0$f;
        for (int d = 0; d < ${NAME}_DIM; d++) {
            along += (x[d] - c[d]) * velocity[d];
            distance += (x[d] - c[d]) * (x[d] - c[d]);
        }
        if (squares[0] * distance > $negligible) continue;
        const $real k = exp$f(-squares[0] * distance);
        for (int d = 0; d < ${NAME}_DIM; d++) {
            velocity[d] -= 2.0$f * squares[0] * k * along * v[d];
            x[d] += k * v[d];
        }
    }
    for (int d = 0; d < ${NAME}_DIM; d++) velocity[d] += not_finite;
}
""")

_EIGENMAP = Template("""\
/* The time law $key the axis, over the progress s. */
static inline $real ${NAME}_$key$f($real s) {
    if (s < $tail) s = $tail;
    return $omega * (s < 1.0$f ? sqrt$f((2.0$f - s) / s) : 1.0$f / s);
}

""")

_KNOTTED = Template("""\
/* The time law $key the axis, over the progress s: where its pieces start, and there h, h' and h''/2. */
static const $real ${NAME}_${key}_law$f[4][$count] = $pieces;
static inline $real ${NAME}_$key$f($real s) {
    const $real *const start = ${NAME}_${key}_law$f[0], *const speed = start + $count, *const slope = speed + $count;
    int low = 0, high = $count;
    while (high - low > 1) {
        const int middle = (low + high) / 2;
        if (start[middle] < s) low = middle;
        else high = middle;
    }
    if (low == 0) return slope[0];
    const $real ahead = (s < start[$count - 1] ? s : start[$count - 1]) - start[low];
    return (speed[low] + ahead * (slope[low] + ahead * slope[$count + low])) / s;
}

""")
