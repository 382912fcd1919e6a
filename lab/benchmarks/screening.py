"""How much the result depends on each constant of the method: every constant is halved and doubled, one at a time, and the
stages that read it are made anew from the artefacts of finished rooms.

    python lab/benchmarks/screening.py FOLDER ROOM... --of iif_core.fitting iif_core.light.emission.gains:BASE_COLOUR_ERROR

`--factors 0.25 0.5 2 4` gives a curve instead of two points. `--table` prints such a file instead: the change of albedo PSNR,
mean and range over its rooms, the constants that matter most first. `--plot` draws it: a panel for each constant, a line for
each room.

FOLDER is the working folder of runs that this very code has finished; ROOM is the name of a derived scene in it, such as
`sky--rooms-ours-s0`. Constants are numbers at the top of a module and defaults of its dataclasses; `--without` leaves out those
that are no choice. `--keep FILE.csv` adds a row for each constant, factor and room as it is done, and skips those that the file
has; the rows of factor 1 are the scores of the runs as they are. Two cases are worked on at a time.

Stages below equal files that do not import the module of the constant are not made anew, nor is anything where stage `emission`
alone imports it and finds the same light: nothing, or too little to be seen, would change. Column `changed` is False or `slight`
there.
"""

from __future__ import annotations

import argparse
import ast
import csv
import json
import os
import shutil
import subprocess
import sys
import tempfile
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from queue import Queue

import numpy as np
import pandas as pd

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))
import lab  # noqa: F401  for the sources of the laboratory
from workflow.artifacts.store import StageReader, material_maps
from workflow.runtime.fingerprint import import_closure
from workflow.scene.normal_form import CaptureReader
from workflow.scoring.scores import MaterialTruth, material_truth

REPOSITORY = Path(__file__).resolve().parents[2]
CODE = ("iif_core", "workflow", "config")
STAGES = ("base", "emission", "shading", "affines")
FACTORS = (0.5, 2.0)
SAME_LIGHT = 0.005
"""Emitters, gains of objects and the error of the level that differ by less than this share are the same light: a change of all
light by it is 0.04 dB of an albedo at 20 dB."""
UNCHANGED = (False, "False", "slight")
DIM = 0.01
"""Emitters of a kind that are dimmer than this share of its brightest one may differ by more."""
SCORES = (
    ("albedo", "psnr", "scaled"),
    ("albedo", "psnr", "raw"),
    ("roughness", "l2", "raw"),
    ("metallic", "l2", "raw"),
)
COLUMNS = ("module", "constant", "value", "factor", "room", *("/".join(s) for s in SCORES), "changed")


@dataclass(frozen=True)
class Constant:
    """A number in the source of a module; `span`: first line, first column, last line, last column (AST, bytes)."""

    module: str
    name: str
    value: float
    span: tuple[int, int, int, int]

    @property
    def path(self) -> Path:
        return Path(*self.module.split(".")).with_suffix(".py")

    def times(self, factor: float) -> float:
        """The value times a factor; whole numbers stay whole, and at least 1 away from what they were."""
        if not isinstance(self.value, int):
            return self.value * factor
        new = round(self.value * factor)
        return new if new != self.value else self.value + (1 if factor > 1 else -1)

    def written_into(self, source: str, factor: float) -> str:
        """The source of the module with the constant times the factor."""
        lines = source.encode().splitlines(keepends=True)
        first, start, last, end = self.span
        head, tail = lines[first - 1][:start], lines[last - 1][end:]
        lines[first - 1 : last] = [head + repr(self.times(factor)).encode() + tail]
        return b"".join(lines).decode()


def number(node: ast.expr | None) -> float | int | None:
    """The value of an expression of literal numbers that can be scaled; None for anything else."""
    if node is None or not all(
        isinstance(part, ast.Constant | ast.BinOp | ast.UnaryOp | ast.operator | ast.unaryop) for part in ast.walk(node)
    ):
        return None
    value = eval(compile(ast.Expression(node), "constant", "eval"))  # literals and operators alone
    plain = isinstance(value, int | float) and not isinstance(value, bool)
    return value if plain and np.isfinite(value) and value != 0 else None


def constants_of(module: str) -> list[Constant]:
    """Numbers at the top of a module, and defaults of the fields of its dataclasses."""
    path = REPOSITORY / Path(*module.split(".")).with_suffix(".py")
    found = []
    for node in ast.parse(path.read_text()).body:
        pairs: list[tuple[str, ast.expr | None]] = []
        if isinstance(node, ast.Assign) and isinstance(node.targets[0], ast.Name):
            pairs = [(node.targets[0].id, node.value)]
        elif isinstance(node, ast.Assign) and isinstance(node.targets[0], ast.Tuple) and isinstance(node.value, ast.Tuple):
            pairs = [(t.id, v) for t, v in zip(node.targets[0].elts, node.value.elts, strict=True) if isinstance(t, ast.Name)]
        elif isinstance(node, ast.ClassDef):
            fields = [field for field in node.body if isinstance(field, ast.AnnAssign) and isinstance(field.target, ast.Name)]
            pairs = [(f"{node.name}.{field.target.id}", field.value) for field in fields]
        for name, value in pairs:
            plain = number(value)
            if value is not None and plain is not None:
                span = (value.lineno, value.col_offset, value.end_lineno, value.end_col_offset)
                found.append(Constant(module, name, plain, span))
    return found


def chosen(names: list[str]) -> list[Constant]:
    """Constants of modules, of packages, or `module:NAME`."""
    found = []
    for name in names:
        module, _, only = name.partition(":")
        path = REPOSITORY / Path(*module.split("."))
        files = sorted(path.rglob("*.py")) if path.is_dir() else [path.with_suffix(".py")]
        modules = [".".join(file.relative_to(REPOSITORY).with_suffix("").parts) for file in files if file.name != "__init__.py"]
        every = [constant for m in modules for constant in constants_of(m)]
        here = [constant for constant in every if not only or constant.name == only]
        if not here:
            raise SystemExit(f"{name}: no such constant; {module} has {', '.join(c.name for c in every) or 'none'}")
        found.extend(here)
    return found


def reads(stage: str, module: str) -> bool:
    """Whether a stage imports a module; it may then read any constant of it."""
    return module in import_closure(f"workflow.stages.{stage}")


def first_stage(module: str) -> str | None:
    """The first stage that reads a module; None if none of them does."""
    return next((stage for stage in STAGES if reads(stage, module)), None)


def reader(folder: Path, scene: str, stage: str) -> StageReader:
    return StageReader(folder / "results" / scene / stage, stage, scene)


@cache
def truths(folder: Path, scene: str) -> dict[str, MaterialTruth]:
    """The truth of the views, by name of the view; the runs differ in what comes after it."""
    capture, segmentation = CaptureReader(reader(folder, scene, "capture")), reader(folder, scene, "segmentation")
    return {view.name: material_truth(capture, segmentation, view) for view in capture.views}


def scores(folder: Path, scene: str, truth_of: dict[str, MaterialTruth]) -> list[float]:
    """The scores of the result, means over the views."""
    result = reader(folder, scene, "affines")
    values: dict[tuple[str, str, str], list[float]] = {key: [] for key in SCORES}
    for name, truth in truth_of.items():
        file = f"maps/{name}.exr"
        if not result.has(file):
            continue
        maps = material_maps(result.exr(file))
        for quantity in dict.fromkeys(key[0] for key in SCORES):
            for score in truth.scores(maps, quantity, ("psnr", "l2"), ("raw", "scaled")):
                if (quantity, score.metric, score.protocol) in values:
                    values[quantity, score.metric, score.protocol].append(score.value)
    return [float(np.mean(values[key])) for key in SCORES]


def linked(folder: Path, scene: str, into: Path) -> None:
    """The finished run of a scene elsewhere, without copying its files; stages replace files and never write into them."""
    shutil.rmtree(into / "results", ignore_errors=True)
    shutil.copytree(folder / "results" / scene, into / "results" / scene, copy_function=os.link)
    for name in ("data", "config"):
        if (folder / name).exists() and not (into / name).exists():
            (into / name).symlink_to((folder / name).resolve())


def digests(folder: Path, scene: str, stage: str) -> dict[str, str]:
    files = json.loads((folder / "results" / scene / stage / "manifest.json").read_text())["files"]
    return {name: facts["sha256"] for name, facts in files.items() if not name.endswith(".json")}


def same_light(folder: Path, other: Path, scene: str) -> bool:
    """Whether two runs of stage `emission` found the same emitters, of the same radiance, and the same gains (`SAME_LIGHT`)."""
    one, two = reader(folder, scene, "emission"), reader(other, scene, "emission")
    tables = [pd.DataFrame(stage.table("emitters.parquet")) for stage in (one, two)]
    if len(tables[0]) != len(tables[1]) or (tables[0].kept != tables[1].kept).any():
        return False
    brightest = tables[0].groupby("kind").radiance_g.transform("max") * DIM
    bright = (tables[0].radiance_g > brightest).to_numpy()
    pairs = [tuple(table.loc[bright, f"radiance_{c}"].to_numpy() for table in tables) for c in "rgb"]
    pairs += [tuple(stage.table("object_gains.parquet")[f"gain_{c}"] for stage in (one, two)) for c in "rgb"]
    pairs += [tuple(np.array([stage.json("emission.json")["level_error"] or 0.0]) for stage in (one, two))]
    return all(np.allclose(a, b, rtol=SAME_LIGHT, atol=1e-6) for a, b in pairs)


def tried(folder: Path, code: Path, scene: str, constant: Constant, factor: float) -> tuple[list[float], bool | str]:
    """The scores with the constant times the factor, and whether anything changed: `slight`, if the light is the same."""
    file = code / constant.path
    source, state = file.read_text(), file.stat()
    file.write_text(constant.written_into(source, factor))
    place = code.with_name(f"{code.name}-run")
    try:
        linked(folder, scene, place)
        reading = [stage for stage in STAGES if reads(stage, constant.module)]
        changed = False
        for stage in STAGES[STAGES.index(reading[0]) :]:
            if not changed and stage not in reading:
                continue
            shutil.rmtree(place / "results" / scene / stage)
            command = [sys.executable, "-m", "workflow", stage, scene, "--threads", "1"]
            environment = {**os.environ, "PYTHONPATH": str(code)}
            environment.pop("PYTHONDONTWRITEBYTECODE", None)  # or every run compiles all modules
            done = subprocess.run(command, cwd=place, env=environment, capture_output=True, text=True)
            if done.returncode:
                print(f"{constant.module}:{constant.name} x {factor}, {scene}, {stage}: {done.stderr[-300:]}", file=sys.stderr)
                return [float("nan")] * len(SCORES), True
            changed = changed or digests(place, scene, stage) != digests(folder, scene, stage)
            if stage == "emission" and changed and reading[-1] == stage and same_light(folder, place, scene):
                return scores(folder, scene, truths(folder, scene)), "slight"
        return scores(place if changed else folder, scene, truths(folder, scene)), changed
    finally:
        file.write_text(source)
        os.utime(file, ns=(state.st_atime_ns, state.st_mtime_ns))  # compiled kernels of this file stay valid


def printed(file: Path) -> None:
    """Print the changes of albedo PSNR up to scale and as it is, in dB, as a table in Markdown: mean (least to largest) over the
    rooms; `same` where no room has another result."""
    rows, columns = _changes(file)[0], ["scaled", "raw"]
    factors = sorted(rows.factor.unique())
    heads = [f"x {factor:g}, {name}" for factor in factors for name in ("up to scale", "as it is")]
    print("| constant | rooms | " + " | ".join(heads) + " |\n" + "|---" * (len(heads) + 2) + "|")
    largest = rows.assign(size=rows[columns].abs().max(axis=1)).groupby(["module", "constant"])["size"].max()
    for module, constant in largest.sort_values(ascending=False).index:
        mine = rows[(rows.module == module) & (rows.constant == constant)]
        cells = []
        for factor in factors:
            here = mine[mine.factor == factor]
            for name in columns:
                value = here[name]
                mean, least, most = (round(float(v), 1) + 0.0 for v in (value.mean(), value.min(), value.max()))  # + 0: no -0
                spread = f"{mean:+.1f} ({least:.1f} to {most:.1f})" if len(here) else ""
                cells.append("same" if len(here) and here.changed.isin(UNCHANGED).all() else spread)
        rooms = mine.groupby("factor").room.nunique()
        count = f"{rooms.min()}" if rooms.min() == rooms.max() else f"{rooms.min()} to {rooms.max()}"
        print(f"| `{constant}` ({mine.value.iloc[0]:g}) | {count} | " + " | ".join(cells) + " |")


def drawn(file: Path, picture: Path) -> None:
    """Draw the change of albedo PSNR up to scale over the factor: a panel for each constant, a line for each room."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot as plt

    rows, plain = _changes(file)
    largest = rows.groupby(["module", "constant"]).scaled.agg(lambda change: change.abs().max()).sort_values(ascending=False)
    columns = min(4, len(largest))
    lines = -(-len(largest) // columns)
    figure, axes = plt.subplots(lines, columns, figsize=(3.1 * columns, 2.5 * lines), sharex=True, squeeze=False)
    for axis in axes.flat[len(largest) :]:
        axis.axis("off")
    unchanged = pd.DataFrame({"factor": [1.0], "scaled": [0.0]})
    for axis, (module, constant) in zip(axes.flat, largest.index, strict=False):
        mine = rows[(rows.module == module) & (rows.constant == constant)]
        every: list[pd.DataFrame] = []
        for _, room in mine.groupby("room"):
            curve = pd.concat([room[["factor", "scaled"]], unchanged]).sort_values("factor")
            axis.plot(curve.factor, curve.scaled, color="0.7", linewidth=0.8)
            every = [*every, curve]
        mean = pd.concat(every).groupby("factor").scaled.mean()
        axis.plot(mean.index, mean, color="C0", linewidth=2, marker="o", markersize=3)
        axis.axhline(0, color="0.3", linewidth=0.5)
        axis.set_xscale("log", base=2)
        axis.set_title(f"{constant} = {mine.value.iloc[0]:g}, {mine.room.nunique()} rooms", fontsize=8)
        axis.tick_params(labelsize=7)
    for axis in axes[:, 0]:
        axis.set_ylabel("albedo, change in dB", fontsize=8)
    for axis in axes[-1]:
        axis.set_xlabel("factor on the constant", fontsize=8)
    figure.tight_layout()
    figure.savefig(picture, dpi=130)


def _changes(file: Path) -> tuple[pd.DataFrame, pd.DataFrame]:
    """Rows of a file with the change of albedo PSNR against the runs as they are, `scaled` and `raw` in dB; and those runs."""
    rows = pd.read_csv(file)
    plain = rows[rows.constant.isna()].drop_duplicates("room", keep="last").set_index("room")
    rows = rows[rows.constant.notna()].copy()
    for name, column in {"scaled": "/".join(SCORES[0]), "raw": "/".join(SCORES[1])}.items():
        rows[name] = rows[column].to_numpy() - plain.loc[rows.room, column].to_numpy()
    return rows, plain


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, nargs="?")
    parser.add_argument("rooms", nargs="*")
    parser.add_argument("--of", nargs="+", default=["iif_core.fitting"], help="packages, modules, or module:NAME")
    parser.add_argument("--without", nargs="+", default=[], help="names of constants, or parts of them")
    parser.add_argument("--factors", nargs="+", type=float, default=FACTORS)
    parser.add_argument("--keep", type=Path, default=Path("screening.csv"))
    parser.add_argument("--table", type=Path, metavar="FILE.csv", help="print this file and do nothing else")
    parser.add_argument("--plot", type=Path, nargs=2, metavar=("FILE.csv", "PICTURE"), help="draw this file and do nothing else")
    arguments = parser.parse_args()
    if arguments.table:
        return printed(arguments.table)
    if arguments.plot:
        return drawn(*arguments.plot)
    if not arguments.rooms:
        parser.error("FOLDER and ROOM are needed")
    # Whole numbers of compiled kernels are sizes of arrays.
    constants = [c for c in chosen(arguments.of) if first_stage(c.module) and not c.module.endswith("kernels")]
    constants = [c for c in constants if not any(part in c.name for part in arguments.without)]
    known = set()
    if arguments.keep.exists():
        with arguments.keep.open() as file:
            known = {(row["module"], row["constant"], float(row["factor"]), row["room"]) for row in csv.DictReader(file)}
    every = [(c, f, r) for c in constants for r in arguments.rooms for f in arguments.factors]
    todo = [(c, f, r) for c, f, r in every if (c.module, c.name, f, r) not in known]
    folder = arguments.folder.resolve()
    plain = {room: scores(folder, room, truths(folder, room)) for room in arguments.rooms}
    with tempfile.TemporaryDirectory(dir=folder, prefix="screening-") as root, ThreadPoolExecutor(2) as pool:
        free: Queue[Path] = Queue()
        for lane in range(2):
            for name in CODE:
                shutil.copytree(REPOSITORY / name, Path(root) / f"code{lane}" / name)
            free.put(Path(root) / f"code{lane}")

        def work(case: tuple[Constant, float, str]) -> tuple[list[float], bool | str]:
            code = free.get()
            try:
                return tried(folder, code, case[2], case[0], case[1])
            finally:
                free.put(code)

        with arguments.keep.open("a", newline="") as file:
            table = csv.writer(file)
            if not file.tell():
                table.writerow(COLUMNS)
            for room in [room for room in arguments.rooms if ("", "", 1.0, room) not in known]:
                table.writerow(["", "", "", 1, room, *(f"{v:.6g}" for v in plain[room]), False])
            for (constant, factor, room), (values, changed) in zip(todo, pool.map(work, todo), strict=True):
                row = [constant.module, constant.name, constant.value, factor, room, *(f"{v:.6g}" for v in values), changed]
                table.writerow(row)
                file.flush()
                moved = " ".join(f"{v - p:+.4f}" for v, p in zip(values, plain[room], strict=True))
                print(f"{constant.module}:{constant.name} x {factor:g} {room}: {moved if changed else 'the same'}", flush=True)


if __name__ == "__main__":
    main()
