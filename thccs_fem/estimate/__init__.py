"""Error indicators, one a cell: the exact error, the residual of the strong form, local problems on bubbles, and goals.

Indicators are not squared; `norm` sums them up. On several ranks each has those of the cells that it owns; all
functions are collective.
"""

from thccs_fem.estimate.bubble import bubble
from thccs_fem.estimate.error import error
from thccs_fem.estimate.goal import goal
from thccs_fem.estimate.indicators import norm
from thccs_fem.estimate.residual import residual

__all__ = ["bubble", "error", "goal", "norm", "residual"]
