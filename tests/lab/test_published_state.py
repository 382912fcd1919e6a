"""The state of a descent that was killed."""

import numpy as np

from lab.published.state import keep_state, kept_state
from workflow.artifacts import StageWriter

PROVENANCE = {"scene": "s", "stage": "base", "fingerprint": "0" * 16}


def test_the_state_of_a_killed_job_comes_back_to_the_same_job_alone(tmp_path):
    folder = tmp_path / "results/s/base"
    arrays = {"a.b": np.arange(6.0).reshape(2, 3), "live": np.array([True, False]), "none": np.zeros((0, 3))}
    facts = {"step": 7, "rng": {"state": 2**127 + 1}, "loss": [0.5]}
    keep_state(StageWriter(folder, PROVENANCE), "descent", arrays, facts)
    again = StageWriter(folder, PROVENANCE)
    found, told = kept_state(again, "descent")
    assert told == facts and found.keys() == arrays.keys()
    for name, array in arrays.items():
        np.testing.assert_array_equal(found[name], array)
        assert found[name].dtype == array.dtype
    assert kept_state(StageWriter(folder, PROVENANCE | {"fingerprint": "1" * 16}), "descent") is None
    assert kept_state(again, "other") is None
    file = folder / "unfinished/descent.npz"
    whole = file.read_bytes()
    for damage in (whole[: len(whole) // 2], b"", b"not an archive", whole[:200] + b"x" * 50 + whole[250:]):
        file.write_bytes(damage)
        assert kept_state(again, "descent") is None
    again.finish()
    assert not file.exists()
