"""Do two environments give the same bytes? Run it in each, and compare:

python lab/benchmarks/environments.py kitchen here.npz [<capture.pkl>]
python lab/benchmarks/environments.py --compare here.npz there.npz

The capture is rendered once and kept next to the first result, so that both runs read the same photographs. Without AVX-512:

NPY_DISABLE_CPU_FEATURES="AVX512F AVX512CD AVX512_SKX AVX512_CLX AVX512_CNL AVX512_ICL AVX512_SPR" OPENBLAS_CORETYPE=Haswell \\
NUMBA_CPU_NAME=haswell NUMBA_CPU_FEATURES=+avx2,+fma,+avx,+sse4.2,+popcnt,+bmi,+bmi2 NUMBA_CACHE_DIR=<an empty folder> python ...
"""

import pickle
import sys
import tempfile
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

PARTS = ("base", "diffuse", "maps")


def run(room: str, out: Path, kept: Path) -> None:
    """Run the stages on one of `chain.ROOMS` and write their rasters."""
    from workflow.runtime import native

    native.process_environment()
    native.prepare()
    native.limit_threads(1)
    from lab.stability import chain

    with tempfile.TemporaryDirectory() as place:
        folder = Path(place)
        if not kept.exists():
            kept.write_bytes(pickle.dumps(chain.make_capture(folder / "capture", chain.ROOMS[room])))
        result = chain.run(pickle.loads(kept.read_bytes()), folder / "run")
    rasters = {f"{part}_{view}": raster for part in PARTS for view, raster in getattr(result, part).items()}
    np.savez(out, power=result.power, **rasters)
    print(f"{out}: power {result.power}")


def compare(first: Path, second: Path) -> None:
    """Print how far the rasters of two runs are apart."""
    with np.load(first) as a, np.load(second) as b:
        for part in PARTS:
            names = [name for name in a.files if name.startswith(f"{part}_")]
            one, other = (np.concatenate([of[name].reshape(-1, of[name].shape[-1]) for name in names]) for of in (a, b))
            apart = np.abs(one.astype(np.float64) - other)
            rms = " ".join(f"{value:.2g}" for value in np.sqrt((apart**2).mean(0)))
            print(f"{part}: {(apart > 0).mean():.1%} of the numbers differ, root mean square by channel {rms}")


if __name__ == "__main__":
    if sys.argv[1] == "--compare":
        compare(*map(Path, sys.argv[2:4]))
    else:
        out = Path(sys.argv[2])
        run(sys.argv[1], out, Path(sys.argv[3]) if len(sys.argv) > 3 else out.with_suffix(".pkl"))
