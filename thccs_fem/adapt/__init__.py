"""Adaptive refinement: mark functions, refine their supports, carry functions over, and the loop of all three.

Between two time steps `remesh` refines and coarsens, and `transfer` carries the solution over.
"""

from thccs_fem.adapt.grading import grade_extraordinary
from thccs_fem.adapt.history import History, Step, Stop
from thccs_fem.adapt.loop import Problem, solve
from thccs_fem.adapt.marking import Marking, Strategy, mark, mark_coarsening, uniform
from thccs_fem.adapt.prediction import MarkingAhead, Prediction, predict
from thccs_fem.adapt.remeshing import coarsen, refine, remesh
from thccs_fem.adapt.transfer import transfer

__all__ = [
    "History",
    "Marking",
    "MarkingAhead",
    "Prediction",
    "Problem",
    "Step",
    "Stop",
    "Strategy",
    "coarsen",
    "grade_extraordinary",
    "mark",
    "mark_coarsening",
    "predict",
    "refine",
    "remesh",
    "solve",
    "transfer",
    "uniform",
]
