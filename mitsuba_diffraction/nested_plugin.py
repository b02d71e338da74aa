"""Plugins made by the constructors of other plugins."""

from __future__ import annotations

import mitsuba as mi


def nested_plugin(kind: str, **parameters: object) -> mi.Object:
    """A plugin without children.

    Unlike mi.load_dict, this leaves Mitsuba's file resolver alone. mi.load_dict exchanges it for the time of the call,
    and other plugins of the scene, which Mitsuba instantiates at the same time on other threads, may ask for it then.
    """
    props = mi.Properties(kind)
    for name, value in parameters.items():
        props[name] = value
    return mi.PluginManager.instance().create_object(props)
