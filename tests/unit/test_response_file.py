"""A measured camera response from a file: read, checked, part of the fingerprint of what uses it."""

import numpy as np
import pyarrow
import pyarrow.parquet
import pytest

from lab.simulated.photographs import response_curve
from tests.errors import refused
from workflow import settings
from workflow.runtime.fingerprint import raw_inputs
from workflow.scene.response_file import read_response_file

GRID = np.linspace(0, 1, 1024)
CURVE = response_curve("filmic").samples(1024)


def _write(path, y=CURVE, x=GRID):
    if path.suffix == ".npy":
        np.save(path, y)
    elif path.suffix == ".parquet":
        pyarrow.parquet.write_table(pyarrow.table({"x": x, "R": y[0], "G": y[1], "B": y[2]}), path)
    else:
        rows = [", ".join(repr(float(v)) for v in row) for row in zip(x, *y, strict=True)]
        path.write_text("\n".join(["x, R, G, B", *rows, ""]))
    return path


@pytest.mark.parametrize("kind", ["npy", "parquet", "csv"])
def test_read_in_every_form(tmp_path, kind):
    curve = read_response_file(_write(tmp_path / f"curve.{kind}"))
    at = np.linspace(0, 1, 333)[:, None].repeat(3, 1)
    np.testing.assert_allclose(curve(at), response_curve("filmic")(at), atol=2e-3)
    np.testing.assert_allclose(curve.inverse(curve(at)), at, atol=1e-9)


def test_flat_ends_and_noise_are_made_invertible(tmp_path):
    y = np.clip(CURVE * 1.05, 0, 1) + 2e-4 * np.random.default_rng(0).uniform(-1, 0, CURVE.shape)
    y[:, 0] = 0
    curve = read_response_file(_write(tmp_path / "c.npy", y))
    assert (np.diff(curve(GRID[:, None].repeat(3, 1)), axis=0) > 0).all()


@pytest.mark.parametrize(
    ("name", "y", "x", "names"),
    [
        ("c.npy", CURVE[:2], GRID, ["(2, 1024)", "(3, samples)"]),
        ("c.npy", CURVE * 255, GRID, ["0 to 255", "0 to 1"]),
        ("c.npy", CURVE[:, ::-1], GRID, ["channel R", "1 to 0"]),
        ("c.npy", np.where(GRID > 0.5, CURVE - 0.2, CURVE), GRID, ["channel R", "0.199"]),
        ("c.npy", np.where(GRID > 0.5, np.nan, CURVE), GRID, ["1024 samples", 2]),
        ("c.npy", CURVE * 0.3, GRID, ["channel R", "0 to 0.3"]),
        ("c.csv", CURVE, GRID * 2, ["0 to 2", "0 to 1"]),
        ("c.parquet", CURVE, GRID[::-1], ["1 to 0", "0 to 1"]),
        ("c.txt", CURVE, GRID, [".csv, .parquet"]),
    ],
)
def test_refused(tmp_path, name, y, x, names):
    with refused(name, *names):
        read_response_file(_write(tmp_path / name, y, x))


@pytest.mark.parametrize("text", ["", "x,R,G\n0,0,0\n1,1,1\n", "x,R,G,B\n0,0,0\n1,1,1,1\n", "x,R,G,B\n0,a,0,0\n1,1,1,1\n"])
def test_a_spoilt_csv_is_an_error_that_names_it(tmp_path, text):
    (tmp_path / "c.csv").write_text(text)
    with refused("c.csv"):
        read_response_file(tmp_path / "c.csv")


def test_the_file_is_an_input_of_the_stage_that_reads_it(tmp_path):
    path = _write(tmp_path / "c.npy")
    assert raw_inputs("emission", {"affines": {"response": {"file": str(path)}}}) == [path]
    assert raw_inputs("emission", {"affines": {"response": "auto"}}) == []
    with refused("affines.response.file", tmp_path / "d.npy", path):
        raw_inputs("emission", {"affines": {"response": {"file": str(tmp_path / "d.npy")}}})


@pytest.mark.parametrize(
    ("value", "key"),
    [("{file: a.csv}", None), ("spline", None), ("{fiel: a.csv}", "affines.response.fiel"), ("emor", "affines.response")],
)
def test_setting(tmp_path, value, key):
    (tmp_path / "config/scenes").mkdir(parents=True)
    text = f"source: {{kind: builtin}}\nprior: {{kind: simulated}}\naffines: {{response: {value}}}\n"
    (tmp_path / "config/scenes/x.yaml").write_text(text)
    if key:
        with refused("config/scenes/x.yaml", key):
            settings.load("x", "draft", tmp_path)
    else:
        got = settings.dump(settings.load("x", "draft", tmp_path))["affines"]["response"]
        assert got == ({"file": "a.csv"} if "file" in value else value)
