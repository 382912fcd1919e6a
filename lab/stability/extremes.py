"""Captures at the extremes, run through the stages and scored against the truth: figures in place of "finite"."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from iif_core.errors import InputError
from lab.stability import chain
from lab.stability.accuracy import Accuracy, accuracy
from lab.stability.chain import Capture
from workflow.decisions import numerics


class Extreme(NamedTuple):
    """Accuracy of a room at one extreme; `says` what the stages warn of, or the message where it is refused; `seconds`: of the
    stages."""

    room: str
    extreme: str
    found: Accuracy | None
    seconds: float
    says: str = ""


Change = Callable[[Capture], Capture]


@dataclass(frozen=True)
class Case:
    """A change of a capture, or other settings with which it is rendered."""

    name: str
    change: Change = lambda capture: capture
    settings: dict[str, dict[str, Any]] | None = None
    rooms: tuple[str, ...] = ("tiny", "kitchen")


def _photos(change: Callable[[NDArray, int], NDArray]) -> Change:
    def apply(capture: Capture) -> Capture:
        photo = {view.name: change(capture.photo[view.name], view.view_id).astype(np.float32) for view in capture.views}
        return replace(capture, photo=photo)

    return apply


def _settings(**sections: dict[str, Any]) -> Change:
    return lambda capture: capture.with_settings(**sections)


def _some_views(count: int) -> Change:
    return lambda capture: replace(capture, views=capture.views[:count])


def _one_prediction(capture: Capture) -> Capture:
    return replace(capture, maps={name: maps[:1] for name, maps in capture.maps.items()})


def _one_object(capture: Capture) -> Capture:
    return replace(capture, instance=np.zeros_like(capture.instance), names=("everything",))


def _face_objects(count: int) -> Change:
    """So many objects: faces are dealt to them in turn."""

    def apply(capture: Capture) -> Capture:
        instance = (np.arange(len(capture.faces)) % count).astype(np.int32)
        return replace(capture, instance=instance, names=tuple(f"face {i}" for i in range(int(instance.max()) + 1)))

    return apply


def _slivers(capture: Capture) -> Capture:
    """As many faces again, on those that are there: without area (two equal corners, three on a line) or a millionth as high."""
    f, v = capture.faces, capture.vertices
    n, middle = len(v), 0.5 * (v[f[:, 0]] + v[f[:, 1]])
    off = middle + np.float32(1e-6) * (v[f[:, 2]] - middle)
    third = np.arange(len(f)) % 3
    line = np.stack([f[:, 0], f[:, 1], n + np.arange(len(f))], 1)
    equal = np.stack([f[:, 0], f[:, 0], f[:, 1]], 1)
    added = np.where((third == 0)[:, None], equal, line).astype(np.int32)
    places = np.where((third == 2)[:, None], off, middle).astype(np.float32)
    return _with_more(replace(capture, vertices=np.concatenate([v, places])), added, capture.instance, capture.emission)


def _with_more(capture: Capture, faces: NDArray, instance: NDArray, emission: NDArray) -> Capture:
    """Further faces that no pixel shows."""
    return replace(
        capture,
        faces=np.concatenate([capture.faces, faces]),
        instance=np.concatenate([capture.instance, instance]).astype(np.int32),
        emission=np.concatenate([capture.emission, emission]).astype(np.float32),
    )


def _hidden(times: int) -> Change:
    """So many times as many faces, in a sheet far outside that nothing sees."""
    return lambda capture: _hidden_faces(times * len(capture.faces))(capture)


def _hidden_faces(count: int) -> Change:
    """About so many faces more, in a sheet far outside that nothing sees."""

    def apply(capture: Capture) -> Capture:
        side = int(np.ceil(np.sqrt(count / 2)))
        low = capture.vertices.min(0) - 5
        i, j = (axis.ravel() for axis in np.meshgrid(np.arange(side + 1), np.arange(side + 1), indexing="ij"))
        vertices = low + np.stack([i, j, np.zeros_like(i)], 1).astype(np.float32) / side
        a = (np.arange(side)[:, None] * (side + 1) + np.arange(side)).ravel()
        b = a + side + 1
        faces = np.concatenate([np.stack([a, b, b + 1], 1), np.stack([a, b + 1, a + 1], 1)]) + len(capture.vertices)
        whole = replace(capture, vertices=np.concatenate([capture.vertices, vertices.astype(np.float32)]))
        whole = replace(whole, names=(*capture.names, "hidden"))
        hidden = len(faces)
        return _with_more(whole, faces.astype(np.int32), np.full(hidden, len(capture.names)), np.zeros((hidden, 3)))

    return apply


def _levels(count: int) -> Change:
    return _photos(lambda image, _: np.round(image * (count - 1)) / (count - 1))


def _unlit(capture: Capture) -> Capture:
    """One photograph is black, and its pixels are marked unusable, as the source of a folder does."""
    changed = _photos(lambda image, view: image * (view != 1))(capture)
    names = {view.name: view.view_id for view in capture.views}
    return replace(changed, valid={name: valid & (names[name] != 1) for name, valid in capture.valid.items()})


def _planted(scene: str, size: int = 48) -> dict[str, dict[str, Any]]:
    return {"source": {"scene": scene}, "capture": {"width": size, "height": size}}


def _spoilt(value: float) -> Change:
    """One pixel in a hundred of the files has this value; they are read as those of a folder are."""
    import OpenEXR

    from workflow.sources.folder_scene.images import load_photo

    def apply(capture: Capture) -> Capture:
        photo, valid = dict(capture.photo), dict(capture.valid)
        with tempfile.TemporaryDirectory() as place:
            for view in capture.views:
                image = capture.photo[view.name]
                bad = np.random.default_rng([29, view.view_id]).random(image.shape[:2]) < 0.01
                image = np.where(bad[..., None], np.float32(value), image).astype(np.float32)
                file = Path(place) / f"{view.name}.exr"
                OpenEXR.File({}, {"RGB": image}).write(str(file))
                read = load_photo(file)
                photo[view.name], valid[view.name] = read.pixels, capture.valid[view.name] & read.valid
        return replace(capture, photo=photo, valid=valid)

    return apply


LDR, HDR = ("kitchen",), ("tiny",)
CASES = (
    Case("as it is"),
    Case("one photograph", _some_views(1)),
    Case("two photographs", _some_views(2)),
    Case("one prediction", _one_prediction),
    Case("64 predictions", settings={"prior": {"samples": 64}}, rooms=HDR),
    Case("349 photographs", settings={"capture": {"views": 349}}, rooms=HDR),
    Case("one black photograph", _photos(lambda image, view: image * (view != 1))),
    Case("the same, its pixels not used", _unlit),
    Case("one saturated photograph", _photos(lambda image, view: np.ones_like(image) if view == 1 else image), rooms=LDR),
    Case("all photographs saturated", _photos(lambda image, _: np.ones_like(image)), rooms=LDR),
    Case("all photographs black", _photos(lambda image, _: 0 * image)),
    Case("4 grey levels", _levels(4), rooms=LDR),
    Case("16 grey levels", _levels(16), rooms=LDR),
    Case("a pixel of 1e6 in every photograph", _photos(lambda image, _: _one_hot(image, 1e6)), rooms=HDR),
    Case("1 % of the pixels NaN", _spoilt(np.nan), rooms=HDR),
    Case("1 % of the pixels infinite", _spoilt(np.inf), rooms=HDR),
    Case("1 % of the pixels negative", _spoilt(-1.0), rooms=HDR),
    Case("roughness 0.02 and 1", settings=_planted("tiny-gloss"), rooms=HDR),
    Case("metal of base colour 0", settings=_planted("tiny-black-metal"), rooms=HDR),
    Case("albedo 0.95 everywhere", settings=_planted("tiny-white"), rooms=HDR),
    Case("lamp of 4 cm2 and 1e6, smaller than a pixel", settings=_planted("tiny-lamp"), rooms=HDR),
    Case("the same in 384 x 384 pixels", settings=_planted("tiny-lamp", 384), rooms=HDR),
    Case("one object", _one_object),
    Case("every face an object", _face_objects(60_000), rooms=HDR),
    Case("5,000 objects, faces dealt in turn", _face_objects(5000), rooms=LDR),
    Case("faces without area and slivers", _slivers),
    Case("99 % of the faces hidden", _hidden(99)),
    Case("20 million faces hidden", _hidden_faces(20_000_000), rooms=HDR),
    Case("temperature 1e-12", _settings(base={"temperature": 1e-12, "final_temperature": 0.0})),
    Case("temperature 1e6", _settings(base={"temperature": 1e6, "final_temperature": 1e6})),
)


def _one_hot(image: NDArray, value: float) -> NDArray:
    out = image.copy()
    out[len(out) // 2, len(out) // 2] = value
    return out


def _warnings(result: chain.Result) -> list[str]:
    """What the stages say of their own result: figures beyond their limits, and that there is no light."""
    documents = result.documents
    notes = [note for note in documents["emission"].get("notes", []) if note.startswith("no emitter")]
    return [*notes, *numerics.warnings(documents.items())]


def measure(cases: tuple[Case, ...] = CASES, rooms: tuple[str, ...] = tuple(chain.ROOMS)) -> Iterator[Extreme]:
    """Run every case on its rooms."""
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place)
        for room in rooms:
            usual = chain.make_capture(folder / room, chain.ROOMS[room])
            for case in cases:
                if room not in case.rooms:
                    continue
                capture = usual
                if case.settings:
                    merged = {**chain.ROOMS[room], **{k: {**chain.ROOMS[room].get(k, {}), **v} for k, v in case.settings.items()}}
                    capture = chain.make_capture(folder / "other", merged)
                capture, start = case.change(capture), time.monotonic()
                try:
                    result = chain.run(capture, folder / "run")
                except InputError as error:
                    yield Extreme(room, case.name, None, time.monotonic() - start, str(error))
                    continue
                found, seconds = accuracy(result, capture), time.monotonic() - start
                yield Extreme(room, case.name, found, seconds, "; ".join(_warnings(result)))
