"""Turntable animations: a camera that orbits the scene."""

from __future__ import annotations

import os
from collections.abc import Iterable, Mapping
from pathlib import Path

import mitsuba as mi
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from ..files import encoded_file
from ..outputs import MARK
from .scene import Materials, load_spectral_scene

_FRAMES_PER_SECOND = 12


def orbit(
    scene_path: str | os.PathLike[str],
    frames: int,
    parameters: Mapping[str, str] | None = None,
    materials: Materials | None = None,
) -> list[tuple[float, ...]]:
    """Return the motions of the first camera for one orbit, counterclockwise as seen from above.

    Frame k rotates it by 360° k/`frames` about the coordinate axis closest to its up vector, through the point on its
    line of sight that is closest to the centre of the scene's bounding box. Each motion is an affine map of world
    space; the first is the identity. `load_spectral_scene` takes them; parameters, materials and errors are as there.
    """
    scene = load_spectral_scene(scene_path, width=1, height=1, parameters=parameters, materials=materials)
    target, up = _view(scene)
    motions = []
    for k in range(frames):
        motion = np.eye(4)
        motion[:3, :3] = Rotation.from_rotvec(2 * np.pi * k / frames * up).as_matrix()
        motion[:3, 3] = target - motion[:3, :3] @ target
        motions.append(tuple(motion.ravel().tolist()))
    return motions


def _view(scene: mi.Scene) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the point the first camera looks at, and the coordinate axis closest to its up vector."""
    to_world = np.array(scene.sensors()[0].world_transform().matrix, np.float64).reshape(4, 4)
    origin, forward, own_up = to_world[:3, 3], to_world[:3, 2] / np.linalg.norm(to_world[:3, 2]), to_world[:3, 1]
    centre = np.ravel(np.array(scene.bbox().center(), np.float64))
    axis = int(np.argmax(np.abs(own_up)))
    up = np.zeros(3)
    up[axis] = np.sign(own_up[axis])
    return origin + forward * (forward @ (centre - origin)), up


def save_animation(previews: Iterable[Path], path: str | os.PathLike[str]) -> None:
    """Join pictures of equal size into a looping animated WebP at twelve frames per second."""
    from PIL import Image

    first, *others = (Image.open(preview).convert("RGB") for preview in previews)
    with encoded_file(path) as stream:
        first.save(
            stream,
            save_all=True,
            append_images=others,
            duration=1000 // _FRAMES_PER_SECOND,
            loop=0,
            quality=85,
            xmp=MARK.encode(),
        )
