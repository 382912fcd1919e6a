"""A Mitsuba scene under new light, with its own shapes and BSDFs, by Mitsuba's path tracer.

The scene is put together once more with a glowing sphere and a uniform environment, both dark at first; a light is a choice of
radiances and positions of it. Point lights and the environment of the scene itself are left out, because they are off.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import mitsuba as mi
import numpy as np

from iif_core.errors import InputError
from iif_core.light.relighting import sphere_mesh
from lab.mitsuba_scene import render, scene
from lab.relit.new_light import NewLight
from workflow.scene.normal_form import CaptureReader, View

if TYPE_CHECKING:
    from workflow.runtime.job import Job

Array = np.ndarray

STILL = (0.0, 0.0, 0.0)
AWAY = np.full(3, -1e4)
"""Where the sphere is kept while it is dark, in metres."""


def room(job: Job, capture: CaptureReader) -> _Room:
    """Load the scene that the settings name."""
    names = [str(name) for name in capture.reader.table("instances.parquet")["name"]]
    return _Room(Path(job.settings.source.path), names)


class _Lamp:
    """A shape with an emitter, and the radiance and the position that it has in the file."""

    def __init__(self, shape: Any):
        self.shape = shape
        light = mi.traverse(shape.emitter())
        self.keys = [key for key in light.keys() if key.startswith("radiance.") and key.rpartition(".")[2] in ("value", "data")]
        self.radiance = {key: _copy(light[key]) for key in self.keys}
        place = mi.traverse(shape)
        self.where = next((key for key in ("vertex_positions", "to_world") if key in place), "")
        self.place = _copy(place[self.where]) if self.where else None
        self.shift = STILL

    def shine(self, on: bool) -> None:
        parameters = mi.traverse(self.shape.emitter())
        for key in self.keys:
            parameters[key] = self.radiance[key] if on else 0 * self.radiance[key]
        if "sampling_weight" in parameters:
            parameters["sampling_weight"] = 1.0 if on else 0.0
        parameters.update()

    def move(self, shift: tuple[float, float, float]) -> None:
        if shift == self.shift:
            return
        self.shift = shift
        parameters = mi.traverse(self.shape)
        if self.where == "vertex_positions":
            parameters[self.where] = mi.Float((np.array(self.place).reshape(-1, 3) + np.float32(shift)).ravel())
        elif self.where == "to_world":
            parameters[self.where] = mi.Transform4f().translate(mi.Vector3f(*shift)) @ self.place
        parameters.update()


def _copy(value: Any) -> Any:
    return type(value)(value)


class _Room:
    def __init__(self, xml: Path, instance_names: list[str]):
        loaded = scene.load(xml)
        by_name = {shape.name: shape for shape in loaded.shapes}
        lamps = {}
        for number, name in enumerate(instance_names):
            shape = by_name.get(name)
            if shape is not None and shape.object.emitter() is not None:
                if shape.placement is not None:
                    raise InputError(f"{xml}: {name} shines and is a member of a shape group, which cannot be switched alone")
                lamps[number] = _Lamp(shape.object)
        self._loaded, self._lamps = loaded, lamps
        others = [s.object for s in loaded.shapes if s.placement is None and s.object.emitter() is not None]
        self._dark = [_Lamp(one) for one in others if not any(one is lamp.shape for lamp in lamps.values())]
        self._unit = sphere_mesh((0.0, 0.0, 0.0), 1.0)
        self._scene = self._rebuilt()
        self._light: NewLight | None = None

    def _rebuilt(self) -> Any:
        vertices, faces = self._unit
        ball = mi.Mesh("ball", len(vertices), len(faces), props=_ball_properties())
        parameters = mi.traverse(ball)
        parameters["vertex_positions"] = (1e-3 * vertices + AWAY).astype(np.float32).ravel()
        parameters["faces"] = faces.astype(np.uint32).ravel()
        parameters.update()
        self._ball = ball
        parts = {f"shape{i:05d}": shape for i, shape in enumerate(self._loaded.scene.shapes())}
        sky = {"type": "constant", "radiance": {"type": "rgb", "value": [0.0, 0.0, 0.0]}}
        return mi.load_dict({"type": "scene", **parts, "ball": ball, "sky": sky})

    def relit(self, light: NewLight, view: View, samples: int, max_bounces: int, seed: int) -> tuple[Array, Array]:
        if light != self._light:
            self._switch(light)
        integrator = render.path_integrator(max_bounces)
        image, valid, _ = render.render_view(self._scene, integrator, view, samples, seed)
        return image, valid

    def _switch(self, light: NewLight) -> None:
        for lamp in self._dark:
            lamp.shine(False)
        for number, lamp in self._lamps.items():
            lamp.shine(number == light.lamp)
            lamp.move(light.shift if light.shift is not None and number == light.lamp else STILL)
        parameters = mi.traverse(self._scene)
        outside = light.environment or STILL
        glow, centre, radius = STILL, AWAY, 1e-3
        if light.ball is not None:
            glow, centre, radius = light.ball.radiance, np.array(light.ball.centre), light.ball.radius
        parameters["ball.vertex_positions"] = mi.Float((centre + radius * self._unit[0]).astype(np.float32).ravel())
        parameters["ball.emitter.radiance.value"] = mi.Color3f(*glow)
        parameters["sky.radiance.value"] = mi.Color3f(*outside)
        parameters["ball.emitter.sampling_weight"] = 1.0 if any(glow) else 0.0
        parameters["sky.sampling_weight"] = 1.0 if any(outside) else 0.0
        parameters.update()
        self._light = light


def _ball_properties() -> Any:
    properties = mi.Properties()
    properties["bsdf"] = mi.load_dict({"type": "diffuse", "reflectance": {"type": "rgb", "value": [0.0, 0.0, 0.0]}})
    properties["emitter"] = mi.load_dict({"type": "area", "radiance": {"type": "rgb", "value": [0.0, 0.0, 0.0]}})
    return properties
