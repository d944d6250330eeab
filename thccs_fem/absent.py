"""Attributes that users of DOLFINx look for and that have no meaning here."""

from __future__ import annotations

__all__ = ["Absent"]


class Absent:
    """An attribute that is not there: to read it is an `AttributeError` that says what to use in its place.

    Args:
        instead: Why it is not there, and what is.

    >>> class Function:
    ...     interpolate = Absent("splines have no nodal values, use project(value, V)")
    >>> Function().interpolate
    Traceback (most recent call last):
    AttributeError: a Function has no 'interpolate': splines have no nodal values, use project(value, V)
    """

    def __init__(self, instead: str):
        self.instead = instead

    def __set_name__(self, owner: type, name: str) -> None:
        self.name = name

    def __get__(self, instance: object, owner: type) -> Absent:
        if instance is None:  # of the class, as documentation tools do
            return self
        raise AttributeError(f"a {owner.__name__} has no {self.name!r}: {self.instead}", name=self.name, obj=instance)
