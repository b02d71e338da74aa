"""What tracing needs of a scene besides its objects: made once, and again when the scene has changed."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any, TypeVar, cast

import drjit as dr
import mitsuba as mi
import numpy as np

Made = TypeVar("Made")
MAX_COMPARED = 16  # entries of a parameter


class SceneCache:
    """Numbers and arrays that follow from the parameters of a scene and its sensor.

    A parameter has changed if it is another array of Dr.Jit or, where it has at most `MAX_COMPARED` entries, if these
    are other numbers, as NumPy can write them in place; in larger arrays, such as vertices, that goes unnoticed. The
    arrays are held, so that no other gets their index, and operations of Dr.Jit in place make copies. What is made must
    not hold the scene, its shapes or BSDFs: it is kept by the integrator, which the scene holds.
    """

    def __init__(self) -> None:
        self._held: list[Any] = []
        self._state: list[Any] = []
        self._made: dict[str, Any] = {}

    def follow(self, scene: mi.Scene, sensor: mi.Sensor) -> None:
        """Forget what was made if the scene or the sensor is another or has changed."""
        # The parameters of a scene include those of its sensors.
        own = scene.sensors()
        parameters = [item for of in (scene, *([] if sensor in own else [sensor])) for item in _parameters(of)]
        state: list[Any] = [own.index(sensor) if sensor in own else None]
        state += [(name, _identity(value)) for name, value in parameters]
        if state != self._state:
            # Copies, as what `traverse` returns refers to the scene, and changes with it.
            self._held, self._state, self._made = [dr.copy(dr.detach(value)) for _, value in parameters], state, {}

    def once(self, name: str, make: Callable[[], Made]) -> Made:
        """Return the result of `make`, which is called if no result of this name is kept."""
        if name not in self._made:
            self._made[name] = make()
        return cast(Made, self._made[name])


def _parameters(of: mi.Object) -> Iterator[tuple[str, Any]]:
    """Yield the names and values of the parameters that have one: Mitsuba cannot read those of `hair` that do not."""
    parameters = mi.traverse(of)
    return ((name, parameters[name]) for name, (value, *_) in parameters.properties.items() if value is not None)


def _identity(value: Any) -> Any:
    """Return the indices of the arrays in a parameter, its numbers if they are few, or what else it is."""
    indices = dr.detail.collect_indices(value)
    if indices and dr.width(value) > MAX_COMPARED:
        return indices
    return indices, np.array(dr.detach(value)).tolist() if dr.is_array_v(value) else value
