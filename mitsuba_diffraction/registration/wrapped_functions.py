"""The functions of Mitsuba that the package wraps: `load_dict`, `load_file`, `load_string` and `render`.

A scene that is loaded covers the light of its gratings or is refused in one line, models of the package's scenes are
made when they are first loaded, and no garbage is collected while a picture is traced.
"""

from __future__ import annotations

import contextlib
import functools
import gc
import os
import threading
from collections.abc import Callable, Collection, Iterator
from pathlib import Path

import mitsuba as mi

from ..errors import Bug, RequestError, root_cause
from ..handed_over_spectra import hand_over

classes: dict[tuple[str, str], type] = {}
"""Module and variant → class of a plugin. Not in `plugins`, which Mitsuba 3.10 reloads."""
making = threading.Lock()


def wrap_functions(plugins: Collection[str]) -> None:
    """Replace the functions of Mitsuba; `plugins` are the names whose errors are reported in one line."""
    mi.load_file = _with_models(mi.load_file)
    for name in ("load_dict", "load_file", "load_string"):
        setattr(mi, name, _with_short_errors(getattr(mi, name), plugins))
    mi.render = _with_light_covered(mi.render)


def _with_short_errors(load: Callable[..., mi.Object], plugins: Collection[str]) -> Callable[..., mi.Object]:
    """Return a loader that accepts a GratingSpectrum in a dict, and reports errors of the plugins in one line.

    The gratings of a scene are made to cover its light. Unless `parallel` is given, a scene that may have gratings is
    loaded serially: Mitsuba numbers BSDFs as they are constructed, and Dr.Jit writes kernels in the order of these
    numbers. In an order of chance, some processes compiled kernels that the cache has in the other order.
    """

    @functools.wraps(load)
    def loader(scene: dict | str, *args: object, **kwargs: object) -> mi.Object:
        if not args and _may_have(scene, plugins):
            kwargs.setdefault("parallel", False)
        try:
            return _with_light(load(hand_over(scene), *args, **kwargs))
        except RequestError as error:
            line = str(error)
        except RuntimeError as error:
            if not any(f'plugin of type "{name}"' in str(error) for name in plugins):
                raise
            try:
                line = root_cause(error)
            except Bug:
                raise error from None  # with its traceback
        raise RuntimeError(line)

    return loader


def _may_have(scene: object, plugins: Collection[str]) -> bool:
    """Return whether a dictionary, the text of a scene or its file names one of the plugins, or includes a file."""
    if isinstance(scene, dict):
        return any(_may_have(value, plugins) for value in scene.values())
    if not isinstance(scene, str):
        return False
    text = Path(scene).read_text(errors="replace") if scene.endswith(".xml") and os.path.isfile(scene) else scene
    return any(name in text for name in (*plugins, "<include"))


def _with_models(load: Callable[..., mi.Object]) -> Callable[..., mi.Object]:
    """Return `load_file`, which first makes the models of the package's scenes, as the command `render` does."""

    @functools.wraps(load)
    def loader(path: str, *args: object, **kwargs: object) -> mi.Object:
        if os.path.isfile(path) and b"made by:" in Path(path).read_bytes():
            from ..render.scene_file import SceneFile

            own = ("parallel", "optimize")
            with SceneFile(path, {name: str(value) for name, value in kwargs.items() if name not in own}).parsed():
                pass  # made while it is parsed
        return load(path, *args, **kwargs)

    return loader


def _with_light(loaded: mi.Object) -> mi.Object:
    """Return a scene whose gratings cover its light; if they cannot, only this frame has referred to it."""
    if isinstance(loaded, mi.Scene) and classes:
        from ..render.scene_light import warn_of_missing_boxes

        _cover_light(loaded)
        warn_of_missing_boxes(loaded)
    return loaded


def _cover_light(scene: mi.Scene, *sensor: mi.Sensor | int) -> None:
    if classes:
        from ..bsdf.light import cover_light

        cover_light(scene, *sensor)


def _count_gratings() -> int:
    if not classes:
        return 0
    from ..bsdf.base import living

    return len(living)


_count = 0  # of gratings at the last picture


@contextlib.contextmanager
def _garbage_withheld() -> Iterator[None]:
    """Collect garbage before a picture is traced, if there are more gratings than at the last one, but not inside.

    Dr.Jit calls all gratings in the kernels of all scenes, and where Python frees a BSDF while Dr.Jit traces, the
    process dies (Mitsuba 3.9.1, any BSDF). Python's collector, which runs because a grating is Python code, frees
    scenes that stand in reference cycles of the user.
    """
    global _count
    was_enabled = gc.isenabled()
    if was_enabled and _count_gratings() > _count:
        gc.collect()
    _count = _count_gratings()
    gc.disable()
    try:
        yield
    finally:
        if was_enabled:
            gc.enable()


def _with_light_covered(render: Callable[..., mi.TensorXf]) -> Callable[..., mi.TensorXf]:
    """Return `mi.render`, for sensors that are not in the scene, and lights that changed since it was loaded.

    Garbage is not collected while it traces.
    """

    @functools.wraps(render)
    def renderer(
        scene: mi.Scene, params: object = None, sensor: mi.Sensor | int = 0, *args: object, **kwargs: object
    ) -> mi.TensorXf:
        if isinstance(scene, mi.Scene):
            _cover_light(scene, sensor)
        with _garbage_withheld():
            return render(scene, params, sensor, *args, **kwargs)

    return renderer
