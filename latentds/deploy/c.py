"""A velocity field as one C99 header that needs nothing but <math.h>: no allocation, bounded work per call."""

from __future__ import annotations

import os
import re
from string import Template

import torch

from ..files import atomic_write
from .c_text import braces
from .tables import VelocityField, compiled_of, describe


def write(ds: VelocityField, path: str | os.PathLike[str], *, name: str) -> None:
    """Write the velocity of a system as it is now as a C header with two functions, for double and for float.

    ``NAME_velocity`` agrees with this package to rounding. ``NAME_velocityf`` computes in float alone, for processors
    without double; it is off by as much as the velocity changes when the position is rounded to float: 1e-7 to 1e-4 of
    the largest speed as the field is steep, more where ψ nearly folds and within a thousandth of SDS-EF's way to the
    goal. Both do bounded work, at most eight steps a layer, on the stack, and keep nothing between calls, so that
    threads may share them. ``velocity`` may be ``y`` itself. A position that is not finite has a velocity of NaN,
    except under ``-ffast-math``.

    Args:
        ds: a system of locally weighted translations with the dynamics of this package, or SDS-EF; fitted or not, in
            any dtype and on any device.
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
    tables = compiled_of(ds)
    text = _FRAME.substitute(
        NAME=name,
        about="\n".join(f" * {key}: {value}" for key, value in describe(ds).items()),
        dim=ds.dim,
        goal=braces(ds.attractor.detach().to("cpu", torch.float64).numpy(), ""),
        in_double=tables.in_c(name, "double"),
        in_float=tables.in_c(name, "float"),
    )
    with atomic_write(path) as file:
        file.write(text.encode("ascii"))


_FRAME = Template("""\
/* The velocity field of a stable dynamical system, written by latentds.
$about
 */
#ifndef ${NAME}_VELOCITY_H
#define ${NAME}_VELOCITY_H

#include <float.h>
#include <math.h>

#define ${NAME}_DIM $dim

static const double ${NAME}_goal[${NAME}_DIM] = $goal;

$in_double
$in_float
#endif
""")
