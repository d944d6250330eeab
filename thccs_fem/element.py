"""The local basis of every piece: 16 uniform bicubic B-splines on the reference square, as a Basix element.

Function ``i + 4 * j`` is B_i(x) B_j(y) with B_0 .. B_3 the four uniform cubic B-splines that do not vanish on [0, 1];
x runs from corner 0 of the piece to corner 1, y from corner 0 to corner 3. The same element, blocked, maps the
geometry: control points go to the kernels as they are. Bernstein functions are numbered alike.
"""

import functools
import math

import numpy as np
import numpy.typing as npt

import basix
import basix.ufl

DEGREE = 3
NUM_FUNCTIONS = (DEGREE + 1) ** 2

# Rows: the cubic Bernstein coefficients of a segment from its B-spline coefficients (knot insertion), times 6.
_TO_BERNSTEIN_TIMES_6 = np.array([[1, 4, 1, 0], [0, 4, 2, 0], [0, 2, 4, 0], [0, 1, 4, 1]])
_TO_BSPLINE = np.array([[6, -7, 2, 0], [0, 2, -1, 0], [0, -1, 2, 0], [0, 2, -7, 6]])  # its inverse, times 6

# The monomials' coefficients, constant first, of the four uniform cubic B-splines on [0, 1], times 6.
_TO_MONOMIALS_TIMES_6 = np.array([[1, 4, 1, 0], [-3, 0, 3, 0], [3, -6, 3, 0], [-1, 3, -3, 1]])

#: Bernstein coefficients = TO_BERNSTEIN @ B-spline coefficients, shape (16, 16).
TO_BERNSTEIN: npt.NDArray[np.float64] = np.kron(_TO_BERNSTEIN_TIMES_6, _TO_BERNSTEIN_TIMES_6) / 36
#: B-spline coefficients = TO_BSPLINE @ Bernstein coefficients, shape (16, 16): integers, none above 49.
TO_BSPLINE: npt.NDArray[np.float64] = np.kron(_TO_BSPLINE, _TO_BSPLINE).astype(np.float64)
TO_BERNSTEIN.setflags(write=False)
TO_BSPLINE.setflags(write=False)


def bernstein_values(t: npt.ArrayLike) -> npt.NDArray[np.float64]:
    """Return the four cubic Bernstein polynomials at points in [0, 1] of any shape, as a last axis of length 4."""
    t = np.asarray(t, dtype=np.float64)
    return np.stack([math.comb(3, i) * t**i * (1.0 - t) ** (3 - i) for i in range(4)], axis=-1)


def bspline_values(t: npt.ArrayLike) -> npt.NDArray[np.float64]:
    """Return the four uniform cubic B-splines at points in [0, 1] of any shape, as a last axis of length 4."""
    return bernstein_values(t) @ (_TO_BERNSTEIN_TIMES_6 / 6)


def bernstein_slopes(t: npt.ArrayLike) -> npt.NDArray[np.float64]:
    """Return the derivatives of the four cubic Bernstein polynomials, as a last axis of length 4."""
    t = np.asarray(t, dtype=np.float64)
    quadratic = np.stack([(1.0 - t) ** 2, 2.0 * t * (1.0 - t), t**2], axis=-1)
    zero = np.zeros_like(quadratic[..., :1])
    return 3.0 * (np.concatenate([zero, quadratic], axis=-1) - np.concatenate([quadratic, zero], axis=-1))


def bspline_slopes(t: npt.ArrayLike) -> npt.NDArray[np.float64]:
    """Return the derivatives of the four uniform cubic B-splines, as a last axis of length 4."""
    return bernstein_slopes(t) @ (_TO_BERNSTEIN_TIMES_6 / 6)


def bicubic_values(points: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """Return the 16 functions at points of the reference square, shape (..., 2), as a last axis of length 16."""
    x, y = np.moveaxis(bspline_values(points), -2, 0)
    return (y[..., :, None] * x[..., None, :]).reshape(*x.shape[:-1], NUM_FUNCTIONS)


def restrictions(origin: npt.NDArray[np.float64], axes: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """Return the matrices that take local B-spline coefficients of bicubic polynomials to those on other squares.

    Args:
        origin: Corner (0, 0) of each square, in the coordinates of the piece, shape (n, 2).
        axes: Its edges u and v there, in columns, one of them along x and the other along y, shape (n, 2, 2).

    Returns:
        Shape (n, 16, 16).
    """
    # Coefficient j of a cubic f is its polar form at the knots around it, f[j - 2, j - 1, j].
    step = axes.sum(axis=2)
    s, t, r = (origin[:, :, None] + step[:, :, None] * (np.arange(4) - shift) for shift in (2, 1, 0))
    polar = np.stack([np.ones_like(s), (r + s + t) / 3.0, (r * s + s * t + t * r) / 3.0, r * s * t], axis=-1)
    along_x, along_y = (polar @ (_TO_MONOMIALS_TIMES_6 / 6.0)).swapaxes(0, 1)
    products = np.einsum("njl,nik->njilk", along_y, along_x)
    turned = axes[:, 0, 0] == 0.0  # there x depends on v
    products[turned] = products[turned].swapaxes(1, 2)
    return products.reshape(-1, 16, 16)


@functools.cache
def bspline() -> basix.ufl._ElementBase:
    """Return the scalar element."""
    # Basix wants the functions by their dual basis: point values on a grid, combined by the inverse of the
    # collocation matrix. All of them count as interior, since pieces are joined by extraction operators alone.
    line = np.array([0.0, 0.25, 0.75, 1.0])  # the best conditioned: extrema of the Chebyshev polynomial
    values = bspline_values(line)
    dual = np.linalg.inv(values)
    x, y = np.meshgrid(line, line)
    points = np.column_stack([x.ravel(), y.ravel()])
    interior = np.kron(dual, dual).reshape(NUM_FUNCTIONS, 1, NUM_FUNCTIONS, 1)
    no_points, no_dofs = np.zeros((0, 2)), np.zeros((0, 1, 0, 1))
    return basix.ufl.custom_element(
        basix.CellType.quadrilateral,
        (),
        np.eye(NUM_FUNCTIONS),
        [[no_points] * 4, [no_points] * 4, [points], []],
        [[no_dofs] * 4, [no_dofs] * 4, [interior], []],
        interpolation_nderivs=0,
        map_type=basix.MapType.identity,
        sobolev_space=basix.SobolevSpace.H2,
        discontinuous=False,
        embedded_subdegree=DEGREE,
        embedded_superdegree=DEGREE,
        polyset_type=basix.PolysetType.standard,
        dtype=np.float64,
    )


@functools.cache
def blocked(shape: tuple[int, ...]) -> basix.ufl._ElementBase:
    """Return the element of functions with values of the shape; ``()`` is the scalar one.

    Component c (in C order) of function i has the local number ``i * block size + c``.
    """
    return basix.ufl.blocked_element(bspline(), shape=shape) if shape else bspline()


@functools.cache
def constant(shape: tuple[int, ...]) -> basix.ufl._ElementBase:
    """Return the element of functions that are constant on each piece, with values of the shape."""
    return basix.ufl.element("DG", "quadrilateral", 0, shape=shape or None)


def coordinate_element(gdim: int) -> basix.ufl._ElementBase:
    """Return the element that maps the reference square into R^gdim."""
    return blocked((gdim,))
