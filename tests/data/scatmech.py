"""Makes scatmech.json: efficiencies by NIST's coupled-wave solver, `python tests/data/scatmech.py > scatmech.json`.

Needs pySCATMECH 0.1.10, which is compiled when it is installed; a few minutes. Incidence is conical, turned by 50°; the
wavelength is 0.55 µm, the period 1 µm, the depth 0.2 µm. Light from above is reflected (type 0) or transmitted (1),
light from below, inside of the medium, is reflected (2) or transmitted (3); "angle" is that of the light, in degrees
from the normal. "s" is of light that is polarised perpendicular to the plane of incidence.
"""

import json
import os
import sys

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


def case(profile, n, k, harmonics, way, angle):
    from pySCATMECH.rcw import RCW_Model

    grating, shape = PROFILES[profile]
    index = f"({n},{k})"
    model = RCW_Model(grating=grating)
    parameters = {"lambda": 0.55, "thetai": angle, "rotation": 50, "order": harmonics, "type": way}
    parameters |= {"grating.period": 1, "grating.medium_i": "(1,0)", "grating.medium_t": index}
    parameters |= {"grating.material": index} | {f"grating.{name}": value for name, value in shape.items()}
    for name, value in parameters.items():
        model.setParameters({name: str(value)})
    unpolarised, s = {}, {}
    for m in range(-6, 7):
        matrix = np.array(model.DiffractionEfficiency(m))
        if matrix[0, 0] > 0:
            unpolarised[m] = float(f"{matrix[0, 0]:.6g}")
            s[m] = float(f"{matrix[0, 0] + matrix[0, 1]:.6g}")
    found = {"unpolarised": unpolarised, "s": s}
    return {"profile": profile, "index": [n, k], "harmonics": harmonics, "type": way, "angle": angle, **found}


if __name__ == "__main__":
    out, silent = os.dup(1), os.open(os.devnull, os.O_WRONLY)
    os.dup2(silent, 1), os.dup2(silent, 2)  # it tells of every layer
    results = [case(*arguments) for arguments in CASES]
    sys.stdout.flush()
    os.dup2(out, 1)
    print(json.dumps(results, indent=1))
