"""Makes tests/data/scatmech.json and scatmech_orders.json: efficiencies by NIST's coupled-wave solver.

Needs pySCATMECH of the extra `reference`, which is compiled when it is installed. The period is 1 µm, the depth 0.2 µm.
Light from above is reflected (type 0) or transmitted (1), light from below, inside of the medium, is reflected (2) or
transmitted (3); "angle" is that of the light, in degrees from the normal. In scatmech.json incidence is conical, turned
by 50°, and the wavelength is 0.55 µm. "s" is of light that is polarised perpendicular to the plane of incidence.
"""

import json
import os
from pathlib import Path

import numpy as np

PROFILES = {
    "sinusoidal": ("Sinusoidal_Relief_Grating", {"amplitude": 0.2, "option": 0, "base": 0, "nlevels": 150}),
    "triangular": ("Triangular_Grating", {"amplitude": 0.2, "aspect": 0.8, "nlevels": 150}),
    "lamellar": ("Single_Line_Grating", {"height": 0.2, "topwidth": 0.4, "bottomwidth": 0.4, "nlevels": 1}),
}
CASES = (
    ("sinusoidal", 1.5, 0, 25, 0, 35),
    ("triangular", 1.5, 0, 25, 0, 35),
    ("lamellar", 1.5, 0, 60, 0, 35),
    ("lamellar", 0.8, 6, 150, 0, 35),
    *(("sinusoidal", 1.5, 0, 25, way, 35) for way in (1, 2, 3)),
    *(("triangular", 1.5, 0, 25, way, 35) for way in (1, 2, 3)),
    *(("triangular", 1.5, 0, 25, way, 60) for way in (1, 2)),
    ("lamellar", 1.5, 0, 60, 1, 35),
    ("lamellar", 1.5, 0, 60, 3, 35),
)

# Profile, n, k, harmonics, type, angle, rotation and wavelength in µm: of the table of orders that `export` writes.
ORDERS = (
    ("sinusoidal", 1.5, 0, 25, 0, 0, 0, 0.55),
    ("sinusoidal", 1.5, 0, 25, 1, 20, 0, 0.45),
    ("sinusoidal", 1.5, 0, 25, 0, 40, 90, 0.65),
    ("sinusoidal", 1.5, 0, 25, 1, 60, 50, 0.55),
    ("sinusoidal", 1.9, 0, 75, 0, 60, 0, 0.45),
    ("sinusoidal", 1.9, 0, 25, 1, 5, 50, 0.65),
    ("sinusoidal", 1.9, 0, 25, 0, 20, 50, 0.65),
    ("triangular", 1.5, 0, 25, 0, 20, 50, 0.45),
    ("triangular", 1.5, 0, 25, 1, 40, 0, 0.65),
    ("triangular", 1.5, 0, 25, 1, 5, 90, 0.45),
    ("triangular", 1.9, 0, 25, 0, 40, 0, 0.55),
    ("triangular", 1.9, 0, 25, 1, 20, 90, 0.55),
    ("triangular", 1.9, 0, 25, 0, 60, 50, 0.65),
    ("lamellar", 1.5, 0, 60, 0, 5, 50, 0.65),
    ("lamellar", 1.5, 0, 60, 1, 20, 0, 0.55),
    ("lamellar", 1.9, 0, 60, 0, 40, 50, 0.45),
    ("lamellar", 1.9, 0, 60, 1, 60, 90, 0.65),
    ("lamellar", 0.8, 6, 150, 0, 0, 0, 0.65),
    ("lamellar", 0.8, 6, 150, 0, 20, 90, 0.55),
    ("lamellar", 0.8, 6, 150, 0, 40, 50, 0.45),
)
DATA = Path(__file__).parents[2] / "tests" / "data"


def mueller_matrices(profile, n, k, harmonics, way, angle, rotation, wavelength):
    """m → Mueller matrix, of the orders with light."""
    from pySCATMECH.rcw import RCW_Model

    grating, shape = PROFILES[profile]
    index = f"({n},{k})"
    model = RCW_Model(grating=grating)
    parameters = {"lambda": wavelength, "thetai": angle, "rotation": rotation, "order": harmonics, "type": way}
    parameters |= {"grating.period": 1, "grating.medium_i": "(1,0)", "grating.medium_t": index}
    parameters |= {"grating.material": index} | {f"grating.{name}": value for name, value in shape.items()}
    for name, value in parameters.items():
        model.setParameters({name: str(value)})
    found = {m: np.array(model.DiffractionEfficiency(m)) for m in range(-6, 7)}
    return {m: matrix for m, matrix in found.items() if matrix[0, 0] > 0}


def rounded(value):
    return float(f"{value:.6g}")


def conical(profile, n, k, harmonics, way, angle):
    matrices = mueller_matrices(profile, n, k, harmonics, way, angle, 50, 0.55)
    unpolarised = {m: rounded(matrix[0, 0]) for m, matrix in matrices.items()}
    s = {m: rounded(matrix[0, 0] + matrix[0, 1]) for m, matrix in matrices.items()}
    found = {"unpolarised": unpolarised, "s": s}
    return {"profile": profile, "index": [n, k], "harmonics": harmonics, "type": way, "angle": angle, **found}


def of_table(profile, n, k, harmonics, way, angle, rotation, wavelength):
    matrices = mueller_matrices(profile, n, k, harmonics, way, angle, rotation, wavelength)
    request = {"profile": profile, "index": [n, k], "harmonics": harmonics, "type": way, "angle": angle}
    request |= {"rotation": rotation, "wavelength": wavelength}
    return {**request, "mueller": {m: [rounded(x) for x in matrix.ravel()] for m, matrix in matrices.items()}}


if __name__ == "__main__":
    silent = os.open(os.devnull, os.O_WRONLY)
    os.dup2(silent, 1), os.dup2(silent, 2)  # it tells of every layer
    for name, case, requests in (("scatmech", conical, CASES), ("scatmech_orders", of_table, ORDERS)):
        lines = ",\n".join(json.dumps(case(*request)) for request in requests)
        (DATA / f"{name}.json").write_text(f"[\n{lines}\n]\n", encoding="utf-8")
