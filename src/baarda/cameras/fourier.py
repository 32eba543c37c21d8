"""Fourier sets of degree 1 (16 parameters) and 2 (48 parameters).

With u = pi x / b, v = pi y / b, b the grid half-width, so that -pi <= u, v <= pi over the image:
dx = sum over (m, n) of ac_mn cos(m u + n v) + as_mn sin(m u + n v), dy the same with bc_mn, bs_mn; (m, n) runs over one of each pair
+-(m, n) != (0, 0) with |m|, |n| <= degree. All have the unit of the image plane. (R. Tang, D. Fritsch, M. Cramer, New rigorous and
flexible Fourier self-calibration models for airborne camera calibration, ISPRS J. 71 (2012) 76-85; they scale by 1e-6.) A negative n is
written with a minus: ac_1-1.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from baarda.cameras._terms import correction_model
from baarda.cameras.base import CameraModel, Floats, Parameter, Step, StepFunction, additive


def _waves(frequencies: NDArray[np.intp]) -> StepFunction:
    count = len(frequencies)

    def function(xy: Floats, p: Floats) -> tuple[Floats, Floats, Floats]:
        phase = np.pi * xy @ frequencies.T
        values = np.concatenate([np.cos(phase), np.sin(phase)], axis=1)  # (n, 2 count), the order of each axis
        d_phase = np.concatenate([-values[:, count:], values[:, :count]], axis=1)
        p = np.broadcast_to(p, (len(xy), p.shape[1])).reshape(-1, 2, 2 * count)
        slopes = np.pi * np.concatenate([frequencies, frequencies]).astype(float)
        d_p = np.zeros((len(xy), 2, 4 * count))
        d_p[:, 0, : 2 * count] = d_p[:, 1, 2 * count :] = values
        return np.einsum("nak,nk->na", p, values), np.einsum("nak,nk,kb->nab", p, d_phase, slopes), d_p

    return function


def _model(degree: int) -> CameraModel:
    pairs = [(m, n) for m in range(degree + 1) for n in range(-degree, degree + 1) if m > 0 or n > 0]
    names = [f"{axis}{wave}_{m}{n}" for axis in "ab" for wave in "cs" for m, n in pairs]
    name = f"fourier{degree}"
    step = Step(name, tuple(Parameter(n, 1) for n in names), additive(_waves(np.array(pairs))), additional=True, on_grid=True)
    description = f"Fourier series of degree {degree}, {len(names)} parameters, correct direction"
    return correction_model(name, description, step, 0.1)


fourier1 = _model(1)
fourier2 = _model(2)
