"""The C of velocity fields, one precision at a time: that of translations, and what any other is written with."""

from __future__ import annotations

from collections.abc import Mapping
from string import Template
from typing import Any

import numpy as np

from ..arguments import Array
from ..kernels.adjoint import NEGLIGIBLE
from ..kernels.translations import BEYOND
from ..tabulated import LINEAR_BELOW, LawKind, LawTable
from ..translations import ROOT_STEPS


def filled(template: Template, name: str, real: str, numbers: Mapping[str, Any], **words: Any) -> str:
    """A template in one precision.

    Args:
        template: C with ``$NAME``, ``$real``, the suffix ``$f`` of its functions and numbers, and the ``$LIMITS`` of
            <float.h>.
        name: what the names in it begin with.
        real: "double" or "float".
        numbers: arrays and numbers that C reads, by the names that the template has for them.
        words: what else the template names, as it is.
    """
    suffix, limits = {"double": ("", "DBL"), "float": ("f", "FLT")}[real]
    text = {key: braces(value, suffix) for key, value in numbers.items()}
    return template.substitute(words, **text, NAME=name, real=real, f=suffix, LIMITS=limits)


def braces(numbers: Any, suffix: str) -> str:
    """An array as C writes it: the shortest digits that give each number back."""
    if np.ndim(numbers):
        ends = (",\n    " if np.ndim(numbers) > 1 else ", ").join(braces(part, suffix) for part in numbers)
        return f"{{{ends}}}"
    with np.errstate(over="ignore"):
        value = np.float32(numbers) if suffix else np.float64(numbers)
    if not np.isfinite(value):
        raise ValueError(f"ds: expected parameters that a float can hold, got {numbers:g}")
    return f"{value!s}{suffix}"


def translations(layers: Array, goal: Array, along: LawTable, across: LawTable, name: str, real: str) -> str:
    """Tables and functions of one precision, of what :class:`latentds.deploy.tables.FieldTables` holds."""
    attractor, axis, (length, *_) = goal
    numbers = {
        "layers": layers,
        "attractor": attractor,
        "axis": axis,
        "length": length,
        "beyond": BEYOND,
        "negligible": NEGLIGIBLE,
    }
    laws = "".join(_law(law, key, name, real) for key, law in (("along", along), ("across", across)))
    return filled(_FIELD, name, real, numbers, laws=laws, count=len(layers), steps=ROOT_STEPS)


def _law(law: LawTable, key: str, name: str, real: str) -> str:
    """The function h(s)/s."""
    if law.kind is LawKind.EIGENMAP:
        return filled(_EIGENMAP, name, real, {"tail": LINEAR_BELOW, "omega": law.speeds[0]}, key=key)
    pieces = law.pieces()
    return filled(_KNOTTED, name, real, {"pieces": pieces}, key=key, count=pieces.shape[1])


_FIELD = Template("""\
/* Of each layer: c, v, rho^2, rho^2 |v|^2. */
static const $real ${NAME}_layers$f[$count][2 * ${NAME}_DIM + 2] = $layers;
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
    for (int j = $count - 1; j >= 0; j--) { /* y to the latent point x */
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
    for (int j = 0; j < $count; j++) { /* and both back again */
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
