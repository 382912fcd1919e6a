"""Exceptions."""


class InputError(ValueError):
    """The input cannot be used. The message says what was found, what is allowed and what to do next."""
