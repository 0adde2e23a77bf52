"""Where a robot that drives on a plane faces, as its logs have it."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Self

import numpy as np

from astra_data.core.arrays import Floats
from astra_data.exchange.field_names import HEADING, QUATERNION
from astra_data.exchange.logs import Field


@dataclass(frozen=True)
class Heading:
    """The heading of a robot on a plane.

    Attributes:
        fields: an angle, or its cosine and sine, or parts of a quaternion.
        axes: "" for an angle, "xy" for cosine and sine, and for a quaternion its parts: "zw" or "xyzw".
    """

    fields: tuple[Field, ...]
    axes: str

    @classmethod
    def of(cls, states: Mapping[str, Field]) -> Self | None:
        """Return that of the `states`, by their plain names; None if there is none."""
        for stem in (name[:-2] for name in states if HEADING.fullmatch(name[:-2])):
            if {f"{stem}_x", f"{stem}_y"} <= states.keys():
                return cls((states[f"{stem}_x"], states[f"{stem}_y"]), "xy")
        for name, field in states.items():
            if HEADING.fullmatch(name):
                return cls((field,), "")
        for stem in (name[:-1] for name in states if QUATERNION.fullmatch(name)):
            for axes in ("xyzw", "zw"):
                if {f"{stem}{axis}" for axis in axes} <= states.keys():
                    return cls(tuple(states[f"{stem}{axis}"] for axis in axes), axes)
        return None

    @property
    def name(self) -> str:
        """What the angle is called."""
        return "yaw" if "w" in self.axes else self.fields[0].short[: -len("_x") if self.axes else None]

    def angle(self, values: Floats) -> Floats:
        """Return the angle (T,) of the fields' values (T, F)."""
        if not self.axes:
            return values[:, 0]
        part = dict(zip(self.axes, values.T, strict=True))
        if self.axes == "xy":
            sine, cosine = part["y"], part["x"]
        else:
            x, y, z, w = (part.get(axis, np.zeros(len(values))) for axis in "xyzw")
            sine, cosine = 2 * (w * z + x * y), w**2 + x**2 - y**2 - z**2
        angle: Floats = np.arctan2(sine, cosine)
        return angle

    def abstraction(self, position: list[int], indices: list[int]) -> str:
        """Return the lines of code of φ, by where position and fields are among the state's values."""
        if self.axes == "xy":
            return f"return state[..., {position + indices}]"
        library = "np if isinstance(state, np.ndarray) else torch"
        x, y, *heading = (f"state[..., {index}]" for index in position + indices)
        if not self.axes:
            return (
                f"of, yaw = {library}, {heading[0]}\n"
                f"        return of.stack([{x}, {y}, of.cos(yaw), of.sin(yaw)], -1)"
            )
        names = ", ".join(f"q{axis}" for axis in self.axes)
        cosine, sine = "qw * qw - qz * qz", "2 * qw * qz"
        if self.axes == "xyzw":
            cosine, sine = "qw * qw + qx * qx - qy * qy - qz * qz", "2 * (qw * qz + qx * qy)"
        return (
            f"of, ({names}) = {library}, ({', '.join(heading)})\n"
            f"        return of.stack([{x}, {y}, {cosine}, {sine}], -1)  # yaw of a robot that stands upright"
        )
