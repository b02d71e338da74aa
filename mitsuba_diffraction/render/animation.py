"""Animations: a camera that orbits the scene, and parameters that change from frame to frame."""

from __future__ import annotations

import importlib.util
import subprocess
from collections.abc import Iterable
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryFile
from typing import TYPE_CHECKING, Any

import mitsuba as mi
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from ..errors import RequestError
from ..files.outputs import MARK
from ..files.writing import encoded_file, whole_file
from ..precomputation.surface_text import converted
from .scene_file import SceneFile

if TYPE_CHECKING:
    from PIL import Image

_FRAMES_PER_SECOND = 12


def frames_of(scene_file: SceneFile, count: int) -> list[SceneFile]:
    """Return the scene of each frame, without the motion of an `orbit`.

    Of a parameter of the scene, or of a grating that replaces a BSDF, that is a text `first:last` of two numbers, or of
    two vectors of equal length, frame k has the value first + k (last − first)/(count − 1).

    Raises:
        RequestError: if a text has two vectors of different lengths.
    """
    values = [scene_file.parameters, *scene_file.replacements.values()]
    if not any(_ends(value) for table in values for value in table.values()):
        return [scene_file] * count  # parsed once
    at = [k / (count - 1) for k in range(count)]
    return [
        replace(
            scene_file,
            parameters={name: str(_between(v, fraction)) for name, v in scene_file.parameters.items()},
            replacements={
                bsdf: {name: _between(v, fraction) for name, v in grating.items()}
                for bsdf, grating in scene_file.replacements.items()
            },
        )
        for fraction in at
    ]


def _ends(value: object) -> tuple[NDArray[np.float64], NDArray[np.float64]] | None:
    """Return the numbers of a text `first:last`; None of another value."""
    if not isinstance(value, str) or value.count(":") != 1:
        return None
    try:
        first, last = (np.array(part.replace(",", " ").split(), np.float64) for part in value.split(":"))
    except ValueError:
        return None
    if first.size != last.size:
        raise RequestError(f"{value}: got {first.size} and {last.size} numbers, wanted first:last of as many")
    return first, last


def _between(value: Any, fraction: float) -> Any:
    """Return a value between its ends, as a number or as a text of several; others as they are."""
    if (ends := _ends(value)) is None:
        return value
    texts = [f"{x:.9g}" for x in ends[0] + fraction * (ends[1] - ends[0])]
    return converted(texts[0]) if len(texts) == 1 else ", ".join(texts)


def orbit(scene_file: SceneFile, frames: int) -> list[tuple[float, ...]]:
    """Return the motions of the first camera for one orbit, counterclockwise as seen from above.

    Frame k rotates it by 360° k/`frames` about the coordinate axis closest to its up vector, through the point on its
    line of sight that is closest to the centre of the scene's bounding box. Each motion is an affine map of world
    space; the first is the identity. Lamps are outside of the box. For errors see `SceneFile.load`.
    """
    scene = scene_file.viewed(size=(1, 1)).load()
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
    bbox = mi.ScalarBoundingBox3f()
    for shape in [shape for shape in scene.shapes() if not shape.is_emitter()] or scene.shapes():
        bbox.expand(shape.bbox())
    centre = np.ravel(np.array(bbox.center(), np.float64))
    axis = int(np.argmax(np.abs(own_up)))
    up = np.zeros(3)
    up[axis] = np.sign(own_up[axis])
    return origin + forward * (forward @ (centre - origin)), up


def animations_of(path: Path) -> list[Path]:
    """Return the animations beside a picture: a WebP, a GIF and, with the package imageio-ffmpeg, an MP4."""
    films = [".mp4"] if importlib.util.find_spec("imageio_ffmpeg") else []
    return [path.with_suffix(suffix) for suffix in (".webp", ".gif", *films)]


def save_animation(previews: Iterable[Path], path: Path) -> None:
    """Join pictures of equal size at twelve frames per second: a looping .webp or .gif, or an .mp4 (H.264)."""
    from PIL import Image

    first, *others = (Image.open(preview).convert("RGB") for preview in previews)
    if path.suffix == ".mp4":
        _save_film([first, *others], path)
        return
    marked = {"xmp": MARK.encode(), "quality": 85} if path.suffix == ".webp" else {"comment": MARK.encode()}
    with encoded_file(path) as stream:
        first.save(stream, save_all=True, append_images=others, duration=1000 // _FRAMES_PER_SECOND, loop=0, **marked)


def _save_film(frames: list[Image.Image], path: Path) -> None:
    """Write an .mp4; an odd row or column is cut off, as H.264 has half as many colours."""
    from imageio_ffmpeg import get_ffmpeg_exe

    width, height = (length // 2 * 2 for length in frames[0].size)
    source = f"-f rawvideo -pix_fmt rgb24 -s {width}x{height} -r {_FRAMES_PER_SECOND} -i -".split()
    film = ["-c:v", "libx264", "-crf", "18", "-pix_fmt", "yuv420p", "-metadata", f"comment={MARK}", "-y"]
    with whole_file(path) as temporary, TemporaryFile() as errors:
        call = [get_ffmpeg_exe(), "-loglevel", "error", *source, *film, str(temporary)]
        with subprocess.Popen(call, stdin=subprocess.PIPE, stderr=errors) as process:
            assert process.stdin is not None
            with suppress(BrokenPipeError), process.stdin as stream:
                for frame in frames:
                    stream.write(frame.crop((0, 0, width, height)).tobytes())
        if process.returncode:
            errors.seek(0)
            raise OSError(f"{path}: cannot be written ({' '.join(errors.read().decode(errors='replace').split())})")
