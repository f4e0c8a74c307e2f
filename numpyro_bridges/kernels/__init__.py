"""Kernels: positive definite functions on R^dim with the closed forms that flows need."""

from ._base import (
    AbstractKernel as AbstractKernel,
    AbstractRadialKernel as AbstractRadialKernel,
    KernelCombination as KernelCombination,
)
from ._gaussian import GaussianKernel as GaussianKernel
from ._matern import MaternKernel as MaternKernel
from ._quadrature import QuadratureCovariance as QuadratureCovariance
