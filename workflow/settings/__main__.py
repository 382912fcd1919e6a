"""Writes what is made from the settings: `python -m workflow.settings`."""

from pathlib import Path

from workflow.settings import plan_schema_json, reference_markdown, schema_json

if __name__ == "__main__":
    Path("config/scene.schema.json").write_text(schema_json())
    Path("config/relight.schema.json").write_text(plan_schema_json())
    Path("docs/reference/settings.md").write_text(reference_markdown())
