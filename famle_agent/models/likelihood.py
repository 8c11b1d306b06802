"""How likely an error of a model is: the density of a Gaussian or of a Student-t, and the scale that fits best."""

from __future__ import annotations

import math

import torch
from torch import Tensor

__all__ = ["fitted_scale", "log_density", "trust"]

_MIN_SCALE = 1e-3  # of a normalised target; keeps the likelihood finite where the model is exact
_EM_STEPS = 20


def log_density(residual: Tensor, degrees_of_freedom: float) -> Tensor:
    """Computes the log density of residuals of scale 1, elementwise.

    Args:
        residual: Errors divided by their scale.
        degrees_of_freedom: nu of a Student-t; 0 is a Gaussian.
    """
    nu = degrees_of_freedom
    if not nu:
        return -0.5 * residual.square() - 0.5 * math.log(2 * math.pi)
    constant = math.lgamma((nu + 1) / 2) - math.lgamma(nu / 2) - 0.5 * math.log(nu * math.pi)
    return constant - (nu + 1) / 2 * (residual.square() / nu).log1p()


def trust(squared: Tensor, degrees_of_freedom: float) -> Tensor:
    """Computes how much a squared residual of scale 1 tells about the scale, elementwise; 1 for a Gaussian.

    A Student-t is a Gaussian whose variance is drawn anew for each value: this is what to expect of its inverse.
    """
    nu = degrees_of_freedom
    return (nu + 1) / (nu + squared) if nu else torch.ones_like(squared)


def fitted_scale(squared: Tensor, weight: Tensor, degrees_of_freedom: float) -> Tensor:
    """Finds the scale of maximum likelihood.

    Args:
        squared: Squared errors, (P, n, dim).
        weight: 1 for an error that counts and 0 for padding, (n,).
        degrees_of_freedom: nu of a Student-t; 0 is a Gaussian.

    Returns:
        The scale of each dimension, (P, dim).
    """
    nu, least = degrees_of_freedom, _MIN_SCALE**2
    weight = weight.view(1, -1, 1)
    variance = ((squared * weight).sum(dim=1, keepdim=True) / weight.sum()).clamp(min=least)
    for _ in range(_EM_STEPS if nu else 0):
        weighed = weight * trust(squared / variance, nu) * squared  # expectation maximisation
        variance = (weighed.sum(dim=1, keepdim=True) / weight.sum()).clamp(min=least)
    return variance[:, 0].sqrt()
