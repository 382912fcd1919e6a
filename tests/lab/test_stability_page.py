"""The page of the study of stability is made from the rows that are kept."""

import pandas as pd

from lab.stability import page, record, rows
from lab.stability.scalar import Accuracy
from lab.stability.solvers import Solved
from lab.stability.sums import Order, Summed
from tests.errors import refused
from workflow.report.blocks import fill


def test_the_page_shows_what_was_kept():
    text, frame = record.PAGE.read_text(), record.kept()
    assert set(rows.COLUMNS) == set(frame.columns)
    assert fill(text, page.tables(frame)) == text
    assert {*rows.PARTS, "orders", "measured"} == set(frame["part"])
    judged = frame[frame["limit"].notna()]
    assert (judged["in_order"] == (judged["value"] <= judged["limit"])).all() and judged["in_order"].all()


def _frame():
    accuracy = Accuracy("f", "y", "numpy", "float64", 10, 0.3, 1.5, 1.0, 40.0, 0, (0.5,))
    solved = Solved("s", "diagonal", 4, 1e4, 2.0, 1e-12, 1)
    guarded = Solved(*next(iter(rows.LIMITS)), 4, 1e14, 1e6, float("nan"), 0, "guard")
    summed, order = Summed("way", "float64", "positive", 100, 3.0, 2.0), Order("texture", "threads", 0.0, 0.0)
    parts = (rows.of_kernels([accuracy]), rows.of_solvers([solved, guarded]), rows.of_sums([summed]), rows.of_orders([order]))
    return pd.DataFrame([row for part in parts for row in part], columns=list(rows.COLUMNS))


def test_what_is_above_its_limit_is_counted_and_a_guard_is_named():
    frame = _frame()
    bad = frame[~frame["in_order"]]
    assert set(zip(bad["part"], bad["quantity"], strict=True)) == {
        ("kernels", "ratio"),
        ("solvers", "lost"),
        ("sums", "error / eps"),
    }
    tables = page.tables(frame)
    verdict = {line.split(" | ")[0].strip("| "): line.split(" | ")[3:] for line in tables["verdict"].splitlines()[2:]}
    assert verdict["kernels"][0] == "1" and verdict["sums"][0] == "1" and verdict["orders"][0] == "0"
    assert verdict["solvers"] == ["1", "1 |"] and "guard" in tables["solvers"]
    assert "40 (1.5)" in tables["kernels"] and "the same bytes" in tables["orders"]


def test_a_page_is_filled_again_and_again_and_unknown_tables_are_refused():
    text = "# Title\n\n<!-- table: sums -->\n<!-- end -->\n\nText.\n"
    once = fill(text, {"sums": "| a |"})
    assert once == fill(once, {"sums": "| a |"}) and "| a |" in once and once.endswith("Text.\n")
    with refused("nothing", "sums"):
        fill("<!-- table: nothing -->\n<!-- end -->", {"sums": ""})


def test_unknown_and_missing_parts_are_named(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with refused("kernel", "kernels"):
        record.write_part("kernel")
    with refused("results/studies/stability", "kernels, solvers, sums, relations"):
        record.collect()
    with refused("stability.parquet", "snakemake -s lab/Snakefile"):
        record.keep()
