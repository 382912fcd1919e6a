"""A room under new light: what shines, in terms of its source and of its recovery (lab/docs/evaluation.md#relighting).

The lamps of a source are its emitting objects; those of a recovery are the faces that were found to emit, assigned to the former.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from iif_core.light.base_scene import Light
from iif_core.light.relighting import sphere_mesh
from lab.relit.lamps import Lamp, lamps_of
from workflow.runtime import device
from workflow.scene.normal_form import CaptureReader
from workflow.scene.recovered import Recovered

if TYPE_CHECKING:
    from iif_core.light.transport.scene import Scene

Triple = tuple[float, float, float]


@dataclass(frozen=True)
class Ball:
    """A black sphere that glows: centre and radius in metres, radiance in units of the source."""

    centre: Triple
    radius: float
    radiance: Triple


@dataclass(frozen=True)
class NewLight:
    """The only light in the room; everything else is off.

    Attributes:
        name: unique, names its files.
        kind: `lamp`, `moved`, `environment` or `sphere`.
        lamp: object id of the lamp that shines, -1 = none.
        shift: metres by which it is moved.
        ball: a sphere that glows.
        environment: uniform radiance from outside.
    """

    name: str
    kind: str
    lamp: int = -1
    shift: Triple | None = None
    ball: Ball | None = None
    environment: Triple | None = None

    @property
    def quantity(self) -> str:
        return f"relit_{self.kind}"

    def document(self) -> dict[str, Any]:
        return asdict(self)

    @staticmethod
    def of(document: dict[str, Any]) -> NewLight:
        """Read what `document` wrote."""
        ball = document["ball"]

        def triple(value: Any) -> Triple | None:
            return None if value is None else (float(value[0]), float(value[1]), float(value[2]))

        found = None if ball is None else Ball(triple(ball["centre"]), ball["radius"], triple(ball["radiance"]))
        shift, environment = triple(document["shift"]), triple(document["environment"])
        return NewLight(document["name"], document["kind"], document["lamp"], shift, found, environment)

    def glowing_mesh(self) -> tuple[np.ndarray, np.ndarray, np.ndarray] | None:
        """Return vertices (n, 3), faces (k, 3) and radiance (k, 3) of the sphere; None without one."""
        if self.ball is None:
            return None
        vertices, faces = sphere_mesh(self.ball.centre, self.ball.radius)
        return vertices, faces, np.tile(np.float32(self.ball.radiance), (len(faces), 1))


def source_lamps(capture: CaptureReader) -> list[Lamp]:
    """Return the lamps of the mesh of a capture with true emission, the strongest first."""
    vertices, faces = capture.mesh()
    table = capture.faces()
    if "emission_r" not in table:
        return []
    names: list[str] = []
    if capture.reader.has("instances.parquet"):
        names = [str(name) for name in capture.reader.table("instances.parquet")["name"]]
    emission = np.stack([table[f"emission_{c}"] for c in "rgb"], 1)
    return lamps_of(vertices, faces, table["instance_id"], emission, names)


def relit_world(scene: Recovered, light: NewLight, lamp_of_face: np.ndarray) -> Scene:
    """Return the recovered room under new light, ready for rendering.

    Args:
        scene: of stage affines.
        light: what shines.
        lamp_of_face: (m,) object id of the source's lamp to which each emitting face belongs, -1 = none. Emitting faces that do
            not shine reflect what was fitted for them, as other surface does.
    """
    surface, found = scene.surface, scene.light
    own = found.emits & (lamp_of_face == light.lamp) if light.lamp >= 0 else np.zeros(len(found.emits), bool)
    environment = np.asarray(light.environment or (0.0, 0.0, 0.0), np.float32)
    radiance, side, extra = np.where(own[:, None], found.radiance, 0), found.side, light.glowing_mesh()
    if light.shift is not None and own.any():
        moved = surface.faces[own]
        used, local = np.unique(moved, return_inverse=True)
        shifted = surface.vertices[used] + np.float32(light.shift)
        extra = shifted, local.reshape(-1, 3).astype(np.int32), found.radiance[own]
        extra_side = found.side[own]
        surface = replace(
            surface,
            faces=surface.faces[~own],
            object_id=surface.object_id[~own],
            normals=surface.normals[~own],
            areas=surface.areas[~own],
        )
        radiance, side, own = radiance[~own], side[~own], own[~own]
    elif extra is not None:
        extra_side = np.ones(len(extra[1]), np.int8)
    from iif_core.light.transport.geometry import build_geometry
    from iif_core.light.transport.scene import Scene

    device.mitsuba()
    if extra is None:
        geometry, material = surface.traceable(own)
        return Scene(geometry, material, Light(radiance, side, own, environment).emitters(geometry))
    material = surface.materials()
    black, solid = np.full(len(extra[1]), surface.n_objects, np.int32), np.zeros(len(extra[1]), np.float32)
    geometry = build_geometry(
        np.concatenate([surface.vertices, extra[0]]),
        np.concatenate([surface.faces, extra[1] + len(surface.vertices)]),
        np.concatenate([np.where(own, surface.n_objects, surface.object_id), black]),
        np.concatenate([surface.passes, solid]),
    )
    shining = Light(
        np.concatenate([radiance, extra[2]]),
        np.concatenate([side, extra_side]),
        np.concatenate([own, np.ones(len(extra[1]), bool)]),
        environment,
    )
    return Scene(geometry, material, shining.emitters(geometry))
