"""Run beside the plate solver: centroids in as JSON lines, solved attitudes out."""

import json
import math
import sys

import numpy as np

np.math = math  # a name of NumPy 1 that the solver takes a factorial by

import tetra3  # noqa: E402

solver = tetra3.Tetra3()
for line in sys.stdin:
    field = json.loads(line)
    solution = solver.solve_from_centroids(
        np.array(field["yx"]), field["size"], fov_estimate=field["fov_deg"], fov_max_error=1.0
    )
    print(
        json.dumps(
            {
                key: None if solution[key] is None else float(solution[key])
                for key in ("RA", "Dec", "Roll", "FOV")
            }
        )
    )
