"""Writes what is made from the settings: `python -m workflow.settings`."""

import sys
from pathlib import Path

from workflow import plugins
from workflow.settings import plan_schema_json, reference_markdown, schema_json

if __name__ == "__main__":
    if plugins.modules():
        sys.exit(f"{plugins.VARIABLE}: these files describe the product without plug-ins; unset the variable and run this again")
    Path("config/scene.schema.json").write_text(schema_json())
    Path("config/relight.schema.json").write_text(plan_schema_json())
    Path("docs/reference/settings.md").write_text(reference_markdown())
