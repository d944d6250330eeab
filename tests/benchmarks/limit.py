"""Million points a second for exact evaluation of limit surfaces, all set-up included.

    OMP_NUM_THREADS=1 python tests/benchmarks/limit.py [number of points]

CPU time of one thread, the least of several runs. Points are random; "near" ones lie within 1e-6 of the corners of the
faces of a cube, all of which are extraordinary vertices.
"""

import os
import sys
import time

os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np

from thccs_fem import generators, limit
from thccs_fem.mesh import ControlMesh

REPEATS = 5
N = int(sys.argv[1]) if len(sys.argv) > 1 else 10**6

MESHES = {
    "torus, 2048 faces": generators.torus((64, 32)),
    "torus, 100000 faces": generators.torus((400, 250)),
    "cube-sphere, 6144 faces": generators.cube_sphere(32),
    "genus 3": generators.genus3(),
    "disc, boundary": generators.disc(16),
    "cube, all vertices of valence 3": generators.cube_sphere(1),
    "cube, near": generators.cube_sphere(1),
}


def seconds(mesh: ControlMesh, near: bool, derivatives: int) -> float:
    rng = np.random.default_rng(0)
    faces, uv = rng.integers(mesh.num_faces, size=N, dtype=np.int32), rng.random((N, 2))
    if near:
        uv *= 1e-6
    limit.evaluate(mesh, faces[:1], uv[:1], derivatives)  # loads the compiled loops
    least = np.inf
    for _ in range(REPEATS):
        start = time.process_time()
        limit.evaluate(mesh, faces, uv, derivatives)
        least = min(least, time.process_time() - start)
    return least


def main() -> None:
    print(f"{N} points; million points a second")
    print(f"{'':32} {'position':>9} {'first':>9} {'second':>9}   derivatives")
    for name, mesh in MESHES.items():
        speeds = [N / seconds(mesh, name.endswith("near"), derivatives) / 1e6 for derivatives in (0, 1, 2)]
        print(f"{name:32} " + " ".join(f"{speed:9.2f}" for speed in speeds), flush=True)


if __name__ == "__main__":
    main()
