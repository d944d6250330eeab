"""Problems solved by SciPy, on one rank: nothing needs to be installed for it."""

from thccs_fem.fem.scipy.eigen import EigenProblem
from thccs_fem.fem.scipy.linear import LinearProblem, conjugate_gradients, solve
from thccs_fem.fem.scipy.nonlinear import NonlinearProblem

__all__ = ["EigenProblem", "LinearProblem", "NonlinearProblem", "conjugate_gradients", "solve"]
