"""Weak forms of common equations: UFL in, UFL out, one module an equation.

A module has ``a(u, v)``, the bilinear form, and ``L(f, v)``, the load; or ``F(u, v)``, the residual of a nonlinear
problem, and ``F(u, udot, v)`` of one in time. Most have ``strong_residual(u, f)``, which is zero for the exact solution
and is what :func:`thccs_fem.estimate.residual` wants. Eigenvalue problems have the mass ``m(u, v)``, and what descends
has an ``energy(u)``. Coefficients come after these, then ``gamma``, a penalty, and ``ds``, the part of the boundary
that a term is on. They need UFL alone, so they work with any space of any UFL-based library.
"""
