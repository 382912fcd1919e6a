"""What remains of the noise of path tracing in photographs, after more paths and after denoising with and without the truth:

python lab/benchmarks/path_noise.py kitchen tiny sky

Two views of 128 x 128 pixels a room against 4096 paths a pixel, whose own noise is in all numbers.
"""

import sys
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

SIZE, REFERENCE, VIEWS = 128, 4096, (0, 4)


def errors(name: str) -> dict[str, list[float]]:
    """Return the median relative error of pixels that do not saturate, by picture and view; and the same of sensor noise."""
    from iif_core.camera.pinhole import direction_derivatives, pixel_directions
    from iif_core.light.transport.emitters import Emitters
    from iif_core.light.transport.geometry import build_geometry
    from iif_core.light.transport.render import first_hits, render
    from iif_core.light.transport.scene import PathOptions, Scene
    from lab import rooms
    from lab.simulated.denoise import denoise_alone
    from lab.simulated.photographs import exposures
    from lab.simulated.realism import ELECTRONS, READ_ELECTRONS
    from workflow.models.denoise import denoise

    room = rooms.build(name)
    geometry = build_geometry(room.vertices, room.faces, room.object_id)
    outside = {} if room.environment is None else {"environment": room.environment}
    emitters = Emitters(geometry, room.emission, np.ones(len(room.faces), np.int8), **outside)
    material = room.materials.drjit()
    scene, focal, found = Scene(geometry, material, emitters), 0.5 * SIZE / np.tan(np.radians(room.field_of_view / 2)), {}
    for number in VIEWS:
        pose = room.cameras(max(VIEWS) + 1)[number]
        rays = pixel_directions(focal, focal, SIZE / 2, SIZE / 2, SIZE, SIZE, pose).reshape(-1, 3)
        steps, eye = direction_derivatives(focal, focal, pose), pose[:3, 3]

        def rendered(samples: int, seed: int, eye=eye, rays=rays, steps=steps) -> np.ndarray:
            paths = PathOptions(samples, room.max_bounces, seed)
            return render(scene, eye, rays, paths, jitter=steps).reshape(SIZE, SIZE, 3)

        true, few, many = rendered(REFERENCE, 99), rendered(64, 1), rendered(192, 2)
        guides = [guide.reshape(SIZE, SIZE, 3) for guide in first_hits(geometry, material, eye, rays)[:2]]
        pictures = {"64": few, "192": many, "64, guided": denoise(few, *guides), "192, alone": denoise_alone(many)}
        signal = exposures([true])[0] * true
        usable = ((signal > 0) & (signal < 1)).all(-1)
        for label, picture in pictures.items():
            found.setdefault(label, []).append(float(np.median(np.abs(picture - true)[usable] / true[usable])))
        noise = np.sqrt(ELECTRONS * signal[usable] + READ_ELECTRONS**2) / (ELECTRONS * signal[usable])
        found.setdefault("sensor", []).append(0.6745 * float(np.median(noise)))  # the median size of a normal error
    return found


def main() -> None:
    """Print a line for each room."""
    from workflow.runtime import device, native

    native.prepare()
    device.mitsuba()
    for name in sys.argv[1:]:
        print(name, "; ".join(f"{label}: {100 * np.mean(values):.1f} %" for label, values in errors(name).items()), flush=True)


if __name__ == "__main__":
    main()
