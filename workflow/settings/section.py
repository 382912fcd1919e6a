"""A part of the settings: what all of them have in common."""

from __future__ import annotations

from typing import Any, ClassVar

from pydantic import BaseModel, BeforeValidator, ConfigDict, model_validator


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
    """A part of the settings. Unknown keys are errors. So are numbers that are not finite, and keys that have no effect with the
    chosen solver or model."""

    model_config = ConfigDict(extra="forbid", frozen=True, use_attribute_docstrings=True, allow_inf_nan=False)

    IDLE: ClassVar[dict[str, dict[str, tuple[str, tuple[str, ...]]]]] = {}
    """Setting that chooses -> its value -> (the choice that reads them, settings that this value does not read)."""

    @model_validator(mode="after")
    def _no_idle_settings(self) -> Section:
        fields = type(self).model_fields
        for choice, cases in self.IDLE.items():
            value = getattr(self, choice)
            reader, names = cases.get(value, ("", ()))
            named = [n for n in names if n in self.model_fields_set and getattr(self, n) != fields[n].get_default()]
            if named:
                raise ValueError(
                    f"{', '.join(f'`{name}`' for name in named)}: read by `{reader}` alone and without effect on"
                    f" `{choice}: {value}`; remove it, or set the {choice}"
                )
        return self

    @classmethod
    def without_idle(cls, lower: dict[str, Any], upper: dict[str, Any]) -> dict[str, Any]:
        """Return `lower` without the keys that a choice made in the layer above it, `upper`, leaves without effect.

        A variant of a study that chooses another solver thus does not stumble over what the scene file sets for its own.
        """
        chosen = [cases.get(upper.get(choice), ("", ()))[1] for choice, cases in cls.IDLE.items()]
        idle = {name for names in chosen for name in names}
        return {key: value for key, value in lower.items() if key not in idle}
