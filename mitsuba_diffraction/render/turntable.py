"""A camera that goes round the scene, and the animation of its pictures."""

from __future__ import annotations

import os
import re
import xml.etree.ElementTree as ElementTree
from collections.abc import Iterable, Mapping
from pathlib import Path

import mitsuba as mi
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from ..files import whole_file
from ..outputs import made_for
from .scene import load_spectral_scene

_FRAMES_PER_SECOND = 12


def orbit(
    scene_path: str | os.PathLike[str], frames: int, parameters: Mapping[str, str] | None = None
) -> list[tuple[float, ...]]:
    """The motions that take the first camera once round the scene, anticlockwise seen from above.

    Frame k turns it by 360° k/`frames` about the axis through the target of its `lookat` along that one's `up`. A
    camera without a `lookat` turns about the middle of the scene's bounding box, along the coordinate axis that is
    nearest to the camera's own up.

    Args:
        scene_path: the scene.
        frames: how many, two or more.
        parameters: values for the scene's `$name` parameters.

    Returns:
        One affine map of the world for each frame, as `load_spectral_scene` takes it; the first is the identity.

    Raises:
        ValueError: if there are fewer than two frames, or as for `load_spectral_scene`.
        FileNotFoundError: if there is no such scene.
    """
    if frames < 2:
        raise ValueError(f"frames: got {frames}, wanted two or more")
    scene = load_spectral_scene(scene_path, width=1, height=1, parameters=parameters)
    centre, up = _look_at(scene_path, parameters or {}) or _middle(scene)
    motions = []
    for k in range(frames):
        motion = np.eye(4)
        motion[:3, :3] = Rotation.from_rotvec(2 * np.pi * k / frames * up / np.linalg.norm(up)).as_matrix()
        motion[:3, 3] = centre - motion[:3, :3] @ centre
        motions.append(tuple(motion.ravel().tolist()))
    return motions


def _look_at(
    scene_path: str | os.PathLike[str], parameters: Mapping[str, str]
) -> tuple[NDArray[np.float64], NDArray[np.float64]] | None:
    """Target and up of the first sensor's `lookat` if the XML has one: Mitsuba keeps its matrix alone."""
    root = ElementTree.parse(scene_path).getroot()
    known = {element.get("name"): element.get("value") for element in root.iter("default")} | dict(parameters)

    def vector(text: str) -> NDArray[np.float64]:
        for name in sorted(known, key=len, reverse=True):
            text = text.replace(f"${name}", known[name])
        return np.array([float(number) for number in re.split(r"[\s,]+", text.strip())])

    sensor = root.find("sensor")
    found = None if sensor is None else sensor.find("transform[@name='to_world']/lookat")
    if found is None or len(sensor.find("transform[@name='to_world']")) > 1:
        return None
    return vector(found.get("target")), vector(found.get("up", "0, 1, 0"))


def _middle(scene: mi.Scene) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    own_up = np.ravel(np.array(scene.sensors()[0].world_transform().matrix)).reshape(4, 4)[:3, 1]
    axis = int(np.argmax(np.abs(own_up)))
    up = np.zeros(3)
    up[axis] = np.sign(own_up[axis])
    return np.ravel(np.array(scene.bbox().center())).astype(np.float64), up


def frame_path(picture: Path, frame: int, frames: int) -> Path:
    """`picture.exr` → `picture_007.exr`."""
    digits = max(3, len(str(frames - 1)))
    return picture.with_name(f"{picture.stem}_{frame:0{digits}d}{picture.suffix}")


def save_animation(previews: Iterable[Path], path: str | os.PathLike[str]) -> None:
    """Joins pictures of one size into an animated WebP that repeats for ever, twelve pictures a second."""
    from PIL import Image

    first, *others = (Image.open(preview).convert("RGB") for preview in previews)
    request = made_for(path)
    with whole_file(path) as temporary:
        first.save(
            temporary,
            save_all=True,
            append_images=others,
            duration=1000 // _FRAMES_PER_SECOND,
            loop=0,
            quality=85,
            xmp=b"" if request is None else request.encode(),
        )
