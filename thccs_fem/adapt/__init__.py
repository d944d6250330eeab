"""Adaptive refinement: mark functions, refine their supports, carry functions over, and the loop of all three.

Between two time steps `remesh` refines and coarsens, and `transfer` carries the solution over.
"""

from thccs_fem.adapt.loop import History, Step, solve
from thccs_fem.adapt.marking import Strategy, mark, mark_coarsening
from thccs_fem.adapt.remeshing import coarsen, refine, remesh
from thccs_fem.adapt.transfer import transfer

__all__ = [
    "History",
    "Step",
    "Strategy",
    "coarsen",
    "mark",
    "mark_coarsening",
    "refine",
    "remesh",
    "solve",
    "transfer",
]
