"""Errors that a user can act on."""


class InputError(ValueError):
    """The input cannot be used: the message says what was found, what is allowed and what to do next."""
