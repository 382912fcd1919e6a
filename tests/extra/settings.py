"""Settings that the plug-in adds."""

from typing import Any, Literal

from pydantic import Field

from workflow.settings import base
from workflow.settings.section import Section


class ExtraSource(Section):
    """A source that nobody has."""

    kind: Literal["extra"]
    count: int = Field(3, ge=1)


class Base(base.Base):
    """With a choice of how it is solved."""

    extra: Literal["no", "yes"] = "no"


def solver(document: dict[str, Any]) -> str | None:
    """Choose what solves stage base."""
    return "tests.extra.solver" if document["base"]["extra"] == "yes" else None
