"""The cost of jobs is fitted again from the table that is kept."""

import pytest

from lab import costs as refit
from tests.unit.test_costs import TRUE, planted
from workflow.costs import model, records


def test_jobs_are_added_once_and_the_fit_is_that_of_the_table(tmp_path, monkeypatch):
    table, fits = tmp_path / "costs.csv", tmp_path / "coefficients.json"
    records.write_rows(table, planted(rooms=3))
    new = planted(rooms=4)[-3:]
    monkeypatch.setattr(refit, "gather", lambda folders: [*new, *planted(rooms=3)[:2]])
    lines = refit.refit([tmp_path], table, fits)
    assert lines[1] == f"{table}: 27 jobs, 3 of them new"
    assert refit.refit([tmp_path], table, fits)[1] == f"{table}: 27 jobs, 0 of them new"
    assert any(line.startswith("| render, all | 27 | 4 | ") for line in lines)
    found = model.read_fits(fits)
    assert found == model.fit_rows(records.read_rows(table)) and len(found) == 3


def test_jobs_of_a_slower_machine_fit_as_if_they_were_of_the_first(tmp_path, monkeypatch):
    table, fits = tmp_path / "costs.csv", tmp_path / "coefficients.json"
    records.write_rows(table, planted(rooms=3))
    slow = [row for row in planted(rooms=5) if row["scene"] in ("r3", "r4")]
    for row in slow:
        row.update(cpu_seconds=1.6 * row["cpu_seconds"], seconds=1.6 * row["seconds"])
    monkeypatch.setattr(refit, "gather", lambda folders: slow)
    assert "16 new jobs of a machine that takes 1.6 times as long" in refit.refit([tmp_path], table, fits)[0]
    found = model.read_fits(fits)["render", "all", "cpu_seconds"]
    assert found.coefficients == pytest.approx({name: value for name, value in TRUE.items() if value}, rel=1e-3)
    assert {row["machine"] for row in records.read_rows(table)} == {1.0, 1.6}
