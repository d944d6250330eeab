"""Weak forms of common equations: UFL in, UFL out, one module an equation.

A module has ``a(u, v)``, the bilinear form, and ``L(f, v)``, the load, or for a nonlinear problem
``F(u, v)``, the residual; and ``strong_residual(u, f)``, which is zero for the exact solution and
is what :func:`thccs_fem.estimate.residual` wants. They need UFL alone, so they work with any space
of any UFL-based library.
"""
