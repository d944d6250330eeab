"""Pictures by PyVista of functions on the limit surface, and by Matplotlib of what adaptive runs came to.

On several ranks rank 0 draws.
"""

from thccs_fem.plot.curves import convergence
from thccs_fem.plot.pictures import plot
from thccs_fem.plot.surfaces import mesh_lines, surface

__all__ = ["convergence", "mesh_lines", "plot", "surface"]
