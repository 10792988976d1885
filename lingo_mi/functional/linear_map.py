"""Linear maps and their transposes, on arrays of NumPy, Dr.Jit, PyTorch and JAX."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from numbers import Real
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from scipy.sparse.linalg import LinearOperator, eigsh

from lingo_mi.common.arrays import as_numpy
from lingo_mi.common.errors import InputError, shown
from lingo_mi.common.memory import room
from lingo_mi.common.runtime import drjit_lock, ensure_variant
from lingo_mi.functional.frameworks import framework_of, require_dense
from lingo_mi.projectors.upload import uploaded
from lingo_mi.projectors.usable import require_unfrozen

LARGE = 2**26  # bytes: only larger results are checked to fit, since the check reads files for half a millisecond
BASIS, FEW = 12, 4  # vectors of the Krylov space for an accurate norm, and for a rough one


class LinearMap(ABC):
    """A linear map between arrays of fixed shapes. Leading axes of an array are a batch.

    Attributes
    ----------
    domain_shape, range_shape : tuple of int
        Shapes of its argument and of its result.
    counted : array of bool or True
        Numbers of the argument that add to the result. Others may be NaN.
    """

    domain_shape: tuple[int, ...]
    range_shape: tuple[int, ...]
    counted: np.ndarray | bool = True
    __array_ufunc__ = None  # `A @ array` is an error, not an array of single views

    @property
    @abstractmethod
    def T(self) -> LinearMap:
        """The transpose, exact to rounding; its own transpose is this map."""

    @abstractmethod
    def on_device(self, x: Any) -> Any:
        """The map of one flat, evaluated mi.Float [prod(domain_shape)]: mi.Float [prod(range_shape)]."""

    def __call__(self, x: Any) -> Any:
        """The map of an array [..., *domain_shape]: float32 [..., *range_shape], of the caller's kind, on its device.

        It is differentiable any number of times, in reverse and in forward mode (with Dr.Jit's arrays once).

        Raises
        ------
        InputError
            For an array of another shape, or with NaN or infinity, or if the result does not fit into memory. Gradients that
            flow back may have NaN and infinity.
        """
        kind, name = framework_of(x), repr(self)
        require_unfrozen(name)
        require_dense(x, kind, name)
        if kind == 'NumPy':
            x = as_numpy(x, f'the argument of {name}', np.float32)
        shape = tuple(x.shape)
        if kind == 'Dr.Jit' and not dr.is_tensor_v(x):  # a flat array stands for one
            shape = self.domain_shape if shape == (math.prod(self.domain_shape),) else shape
        if shape[len(shape) - len(self.domain_shape) :] != self.domain_shape:
            raise InputError(f'{name} takes arrays [..., {_text(self.domain_shape)}], not [{_text(shape)}]')
        batch = shape[: len(shape) - len(self.domain_shape)]
        needed = 4 * math.prod((*batch, *self.range_shape))
        if needed > LARGE and needed > room():
            shape = _text((*batch, *self.range_shape))
            raise InputError(f'{name}: a result [{shape}] does not fit into memory: take fewer views or voxels')
        if kind == 'NumPy':
            return self.on_host(x)
        if kind == 'Dr.Jit':
            with drjit_lock():
                return self._of_drjit(x, batch)
        if kind == 'PyTorch':  # imported here, since it is heavy and may be missing
            from lingo_mi.functional.linear_torch import apply_torch

            return apply_torch(self, x)
        from lingo_mi.functional.linear_jax import apply_jax

        return apply_jax(self, x)

    def on_host(self, x: np.ndarray, checked: bool = True) -> np.ndarray:
        """The map of NumPy's array. checked: whether NaN is an error."""
        if checked:
            self.require_finite(np.isfinite(x))
        batch = x.shape[: x.ndim - len(self.domain_shape)]
        out = np.empty((*batch, *self.range_shape), np.float32)
        with drjit_lock():
            ensure_variant()
            for i in np.ndindex(batch):
                out[i] = self.on_device(uploaded(x[i])).numpy().reshape(self.range_shape)
        return out

    def require_finite(self, finite: np.ndarray) -> None:
        """Raises InputError unless all numbers of an argument that count are finite. finite: which are, in any shape."""
        if not (finite.all() or finite.reshape(-1, *self.domain_shape).all(where=self.counted)):
            raise InputError(f'{self!r}: the array has NaN or infinity as float32: replace those values first')

    def _of_drjit(self, x: Any, batch: tuple[int, ...]) -> Any:
        ensure_variant('cuda' if dr.backend_v(x) == dr.JitBackend.CUDA else 'cpu')
        if not math.prod(batch):
            return dr.zeros(mi.TensorXf, (*batch, *self.range_shape))
        flat = mi.Float(x.array if dr.is_tensor_v(x) else x)
        dr.make_opaque(flat)
        finite = dr.isfinite(dr.detach(flat))
        if not dr.all(finite)[0]:
            self.require_finite(finite.numpy())
        n, parts = math.prod(self.domain_shape), []
        for i in range(math.prod(batch)):
            item = (
                flat if not batch else dr.gather(mi.Float, flat, dr.arange(mi.UInt32, n) + dr.opaque(mi.UInt32, i * n))
            )
            dr.eval(item)
            parts.append(dr.custom(_Differentiable, self, item))
        out = parts[0] if len(parts) == 1 else dr.concat(parts)
        return mi.TensorXf(out, (*batch, *self.range_shape)) if dr.is_tensor_v(x) else out

    def norm(self, tolerance: float = 1e-4) -> float:
        """The largest singular value, by Lanczos' method (SciPy).

        Parameters
        ----------
        tolerance : float
            Tolerance of ARPACK, above 0. 1e-4 gives about six digits in some 20 calls of the map and of its transpose. 1e-2 gives
            two or three digits in about 6 calls, which suffices for the length of a step.

        Raises
        ------
        InputError
            For a tolerance that is not a finite number above 0.
        """
        if not (isinstance(tolerance, Real) and not isinstance(tolerance, bool) and 0 < tolerance < math.inf):
            raise InputError(f'tolerance must be a finite number above 0, not {shown(tolerance)}')
        flat = self.aslinearoperator()
        squared = flat.H @ flat
        n, ones = squared.shape[0], np.ones(squared.shape[0], np.float32)
        if not (squared @ ones).any():
            return 0.0
        basis = BASIS if tolerance < 1e-2 else FEW
        if n <= basis:
            return float(np.linalg.norm(squared @ np.eye(n, dtype=np.float32), 2) ** 0.5)
        largest = eigsh(squared, 1, v0=ones, ncv=basis, tol=tolerance, return_eigenvectors=False)  # pyright: ignore[reportArgumentType]
        return float(largest[0] ** 0.5)

    def aslinearoperator(self) -> LinearOperator:
        """The map for `scipy.sparse.linalg`, between flat vectors, with `.H` and `@`."""
        return _Flat(self)


class _Flat(LinearOperator):
    def __init__(self, linear_map: LinearMap):
        super().__init__(np.float32, (math.prod(linear_map.range_shape), math.prod(linear_map.domain_shape)))
        self.map = linear_map

    def _matvec(self, x):
        return self.map(x.reshape(self.map.domain_shape)).ravel()

    def _rmatvec(self, x):
        return self.map.T(x.reshape(self.map.range_shape)).ravel()


class _Differentiable(dr.CustomOp):
    """A map in Dr.Jit's graph, whose derivatives are the map and its transpose."""

    def eval(self, linear_map, x):
        self.map = linear_map
        return linear_map.on_device(x)

    def forward(self):
        self.set_grad_out(self.map.on_device(_evaluated(self.grad_in('x'))))

    def backward(self):
        self.set_grad_in('x', self.map.T.on_device(_evaluated(self.grad_out())))

    def name(self):
        return 'linear map'


def _evaluated(x):
    dr.make_opaque(x)
    return x


def _text(shape: tuple[int, ...]) -> str:
    return ', '.join(map(str, shape))
