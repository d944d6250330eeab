"""Names of the files of pictures."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

__all__ = ["checked"]


def checked(path: Path, endings: Sequence[str] = (".png",)) -> Path:
    """Return the path of a picture if it can be one."""
    if path.suffix not in endings:
        raise ValueError(f"the picture is to be called {str(path)!r}, but the name must end in {', '.join(endings)}")
    if not path.parent.is_dir():
        raise FileNotFoundError(f"there is no directory {str(path.parent)!r} for {path.name!r}; make it first")
    return path
