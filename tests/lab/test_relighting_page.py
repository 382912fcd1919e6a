"""The page of scored relighting is made from the rows that are kept, and a planted table says what it should."""

import pandas as pd

from lab.studies import relighting
from workflow.report.blocks import fill


def rows(*entries: tuple[str, str, bool, str, float], metric: str = "psnr") -> pd.DataFrame:
    """Rows of (variant, light, found, protocol, value) of a planted room."""
    facts = {"scene": "kitchen", "seed": 0, "view": "000", "metric": metric, "seconds": 1.0, "fingerprint": "x"}
    return pd.DataFrame(
        [
            {
                **facts,
                "variant": variant,
                "light": light,
                "quantity": f"relit_{light[:-1]}",
                "found": found,
                "protocol": p,
                "value": v,
            }
            for variant, light, found, p, v in entries
        ]
    )


LAMPS = pd.DataFrame(
    [("kitchen", 3, "bulb", 0.75, True, 0.5, 1.2, "0 1", 0.125), ("kitchen", 4, "pane", 0.25, False, 0.0, 0.0, "", 0.125)],
    columns=list(relighting.LAMP_COLUMNS),
)


def test_the_page_shows_what_was_kept():
    frame, lamps = pd.read_csv(relighting.KEPT), pd.read_csv(relighting.LAMPS)
    assert list(frame.columns) == list(relighting.COLUMNS) and list(lamps.columns) == list(relighting.LAMP_COLUMNS)
    assert not frame.duplicated(list(relighting.KEY)).any() and frame["value"].notna().all()
    text = relighting.PAGE.read_text()
    assert fill(text, relighting.tables(frame, lamps)) == text


def test_a_missed_lamp_counts_and_is_told_apart():
    planted = [("ours", "lamp3", True, "raw", 30.0), ("ours", "lamp3", True, "scaled", 33.0)]
    planted += [("ours", "lamp4", False, "raw", 10.0), ("ours", "lamp4", False, "scaled", 10.0)]
    planted += [("noise", "lamp3", True, "raw", 40.0), ("base", "lamp3", True, "raw", 22.0)]
    made = relighting.tables(rows(*planted), LAMPS)
    assert "| kitchen | 1 of 2 | 20.00 |  | 21.50 | 30.00 |  | 33.00 |" in made["verdict"]
    assert "| asked |  | 26.0 |  | 30.8 |" in made["verdict"]
    assert "| kitchen: ours | 30.00 |  | 33.00 |" in made["methods"] and "kitchen: fused base | 22.00" in made["methods"]
    assert "LuxRemix" in made["methods"] and "noise" not in made["methods"]
    assert "| kitchen | 40.00 |" in made["noise"]
    assert "| kitchen | lamp4 | no: black | 10.00 |" in made["pictures"]
    assert "| kitchen | 3 bulb | 75.0 % | yes | 50 % | 1.20 |" in made["lamps"] and "kitchen 12.5 %" in made["lamps"]


def test_new_rows_take_the_place_of_older_ones_of_their_cell(tmp_path):
    path, order = tmp_path / "kept.csv", ["scene", "variant", "light", "protocol"]
    older = rows(("ours", "lamp3", True, "raw", 1.0), ("ours", "lamp5", True, "raw", 2.0), ("base", "lamp3", True, "raw", 3.0))
    older.to_csv(path, index=False)
    cell = ["scene", "variant", "seed"]
    joined = relighting._joined(rows(("ours", "lamp3", True, "raw", 9.0)), path, cell, order, relighting.COLUMNS)
    assert joined[["variant", "light", "value"]].to_numpy().tolist() == [["base", "lamp3", 3.0], ["ours", "lamp3", 9.0]]
