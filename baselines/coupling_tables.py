"""The velocity field of SDS-EF for what computes it without torch: a compiled function, and C99."""

from __future__ import annotations

from itertools import pairwise
from string import Template
from typing import Any, NamedTuple

import numpy as np

from latentds.arguments import Array
from latentds.deploy.c_text import filled
from latentds.kernels.lanes import WIDTH

from .coupling_sweeps import LEAK, N_UNITS, field_kernel, room_for


class CouplingTables(NamedTuple):
    """The velocity field of SDS-EF as numbers: as :func:`field_kernel` takes them."""

    frequencies: Array
    phases: Array
    amplitudes: Array
    box: Array
    network: Array
    ends: Array
    latent: Array

    def packed(self) -> tuple[Array, ...]:
        return tuple(self)

    def kernel(self, tangents: int) -> Any:
        return field_kernel() if tangents == 0 else None

    def room(self) -> Array:
        dim, (n_layers, _, count) = len(self.latent) - 1, self.phases.shape
        wide = (dim + 1) // 2
        size = 2 * dim + n_layers * wide * (1 + wide) + room_for.py_func(dim, count) + 2 * N_UNITS + 2 * WIDTH
        return np.empty((-(-size // (dim + 2)) + 1, dim + 2))

    def in_c(self, name: str, real: str) -> str:
        n_layers, _, count = self.phases.shape
        (center, scale), (slowest, fastest, duration), guard = self.box, self.ends, self.latent[-1]
        first, second, last = self._units()
        numbers = {
            "features": self._features(),
            "center": center,
            "scale": scale,
            "attractor": self.latent[:-1],
            "guard": guard,
            "first": first,
            "second": second,
            "last": last[0],
            "leak": LEAK,
            "slowest": slowest,
            "fastest": fastest,
            "duration": duration,
        }
        sizes = {"layers": n_layers, "count": count, "units": N_UNITS, "wide": (len(center) + 1) // 2}
        return filled(_FIELD, name, real, numbers, **sizes)

    def _features(self) -> Array:
        """(L, 2, F, n + 1): of every feature of a layer's log-scale and shift its phase, frequencies and amplitudes."""
        dim, (n_layers, _, count) = len(self.latent) - 1, self.phases.shape
        read = [(dim + 1 - layer % 2) // 2 for layer in range(n_layers)]
        W = np.split(self.frequencies.reshape(-1, count), 2 * np.cumsum(read)[:-1])
        A = np.split(self.amplitudes.reshape(-1, count), 2 * np.cumsum(dim - np.array(read))[:-1])
        of_layers: list[Array] = [
            np.concatenate([b[:, None], w.reshape(2, -1, count), a.reshape(2, -1, count)], 1)
            for b, w, a in zip(self.phases, W, A, strict=True)
        ]
        return np.swapaxes(of_layers, 2, 3)

    def _units(self) -> list[Array]:
        """Of each layer of the speed network (out, 1 + in): a row of bias and weights for every unit."""
        layers, rest = [], self.network
        for n_in, n_out in pairwise([len(self.latent) - 1, N_UNITS, N_UNITS, 1]):
            weights, biases, rest = np.split(rest, [n_in * n_out, (n_in + 1) * n_out])
            layers.append(np.column_stack([biases, weights.reshape(n_out, n_in)]))
        return layers


_FIELD = Template("""\
/* Of each layer, of its log-scale and its shift, the features: phase, frequencies and amplitudes of each. */
static const $real ${NAME}_features$f[$layers][2][$count][${NAME}_DIM + 1] = $features;
static const $real ${NAME}_center$f[${NAME}_DIM] = $center;
static const $real ${NAME}_scale$f[${NAME}_DIM] = $scale;
static const $real ${NAME}_latent_goal$f[${NAME}_DIM] = $attractor;

/* Of the network for the speed, unit by unit: bias and weights. */
static const $real ${NAME}_first$f[$units][${NAME}_DIM + 1] = $first;
static const $real ${NAME}_second$f[$units][$units + 1] = $second;
static const $real ${NAME}_last$f[$units + 1] = $last;

static inline $real ${NAME}_unit$f(const $real *unit, const $real *inputs, int count) {
    $real total = unit[0];
    for (int i = 0; i < count; i++) total += unit[1 + i] * inputs[i];
    return total;
}

/* Latent units per second at a normalised point. */
static inline $real ${NAME}_speed$f(const $real u[${NAME}_DIM]) {
    $real first[$units], second[$units];
    for (int i = 0; i < $units; i++) {
        first[i] = ${NAME}_unit$f(${NAME}_first$f[i], u, ${NAME}_DIM);
        if (first[i] < 0.0$f) first[i] *= $leak;
    }
    for (int i = 0; i < $units; i++) {
        second[i] = ${NAME}_unit$f(${NAME}_second$f[i], first, $units);
        if (second[i] < 0.0$f) second[i] *= $leak;
    }
    const $real g = ${NAME}_unit$f(${NAME}_last$f, second, $units);
    return exp$f(g < $slowest ? $slowest : g > $fastest ? $fastest : g) / $duration;
}

/* Units of y per second. */
static inline void ${NAME}_velocity$f(const $real y[${NAME}_DIM], $real velocity[${NAME}_DIM]) {
    $real u[${NAME}_DIM], x[${NAME}_DIM], squared = 0.0$f, not_finite = 0.0$f;
    $real shrinking[$layers][$wide], slopes[$layers][$wide][$wide];
    for (int d = 0; d < ${NAME}_DIM; d++) {
        u[d] = x[d] = (y[d] - ${NAME}_center$f[d]) / ${NAME}_scale$f[d];
        not_finite += 0.0$f * y[d];
    }
    for (int j = 0; j < $layers; j++) { /* y to the latent point x: every second coordinate p moves the others, q */
        $real *const p = x + j % 2, *const q = x + 1 - j % 2;
        const int reads = (${NAME}_DIM + 1 - j % 2) / 2, moves = ${NAME}_DIM - reads;
        $real values[2][$wide] = {{0.0$f}}, steep[2][$wide][$wide] = {{{0.0$f}}};
        for (int half = 0; half < 2; half++) {
            for (int i = 0; i < $count; i++) {
                const $real *const phase = ${NAME}_features$f[j][half][i];
                const $real *const frequencies = phase + 1, *const amplitudes = frequencies + reads;
                $real angle = *phase;
                for (int k = 0; k < reads; k++) angle += frequencies[k] * p[2 * k];
                const $real cosine = cos$f(angle), sine = sin$f(angle);
                for (int m = 0; m < moves; m++) {
                    values[half][m] += amplitudes[m] * cosine;
                    for (int k = 0; k < reads; k++) steep[half][m][k] -= amplitudes[m] * frequencies[k] * sine;
                }
            }
        }
        for (int m = 0; m < moves; m++) {
            const $real grown = q[2 * m] * exp$f(values[0][m]);
            q[2 * m] = grown + values[1][m];
            shrinking[j][m] = exp$f(-values[0][m]);
            for (int k = 0; k < reads; k++) slopes[j][m][k] = grown * steep[0][m][k] + steep[1][m][k];
        }
    }
    for (int d = 0; d < ${NAME}_DIM; d++) { /* the latent velocity */
        velocity[d] = x[d] - ${NAME}_latent_goal$f[d];
        squared += velocity[d] * velocity[d];
    }
    const $real distance = sqrt$f(squared);
    const $real pull = -${NAME}_speed$f(u) / (distance > $guard ? distance : $guard);
    for (int d = 0; d < ${NAME}_DIM; d++) velocity[d] *= pull;
    for (int j = $layers - 1; j >= 0; j--) { /* and back again */
        $real *const p = velocity + j % 2, *const q = velocity + 1 - j % 2;
        const int reads = (${NAME}_DIM + 1 - j % 2) / 2, moves = ${NAME}_DIM - reads;
        for (int m = 0; m < moves; m++) {
            for (int k = 0; k < reads; k++) q[2 * m] -= slopes[j][m][k] * p[2 * k];
            q[2 * m] *= shrinking[j][m];
        }
    }
    for (int d = 0; d < ${NAME}_DIM; d++) velocity[d] = ${NAME}_scale$f[d] * velocity[d] + not_finite;
}
""")
