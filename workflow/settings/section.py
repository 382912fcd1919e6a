"""A part of the settings: what all of them have in common."""

from __future__ import annotations

from pydantic import BaseModel, BeforeValidator, ConfigDict


def word_or_count(*words: str, least: int) -> BeforeValidator:
    """Return a check with one message for a setting that is one of some words or a whole number of at least `least`."""

    def checked(value: object) -> object:
        if value in words or (isinstance(value, int) and not isinstance(value, bool) and value >= least):
            return value
        raise ValueError(f"Needed: {', '.join(map(repr, words))} or a whole number of at least {least}")

    return BeforeValidator(checked)


def word_or_positive(*words: str) -> BeforeValidator:
    """Return a check with one message for a setting that is one of some words or a number above 0."""

    def checked(value: object) -> object:
        if value in words:
            return value
        try:
            number = float(value) if isinstance(value, int | float | str) and not isinstance(value, bool) else 0.0
        except ValueError:
            number = 0.0
        if not 0 < number < float("inf"):
            raise ValueError(f"Needed: {', '.join(map(repr, words))} or a number above 0")
        return number

    return BeforeValidator(checked)


ON_OFF = BeforeValidator(lambda value: ("off", "on")[value] if isinstance(value, bool) else value)
"""For settings that are the words `on` or `off`, which YAML reads as true and false."""


class Section(BaseModel):
    """A part of the settings. Unknown keys are errors, and so are numbers that are not finite."""

    model_config = ConfigDict(extra="forbid", frozen=True, use_attribute_docstrings=True, allow_inf_nan=False)
