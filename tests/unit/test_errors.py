"""The helper by which tests ask what a message names."""

import pytest

from iif_core.errors import InputError
from tests.errors import missing, named, refused

MESSAGE = "config/scenes/x.yaml: `capture.views`: found -3.5, allowed are 1 ... 64; set --quality draft"


@pytest.mark.parametrize("name", ["config/scenes/x.yaml", "x.yaml", "capture.views", "views", "-3.5", 1, 64, "--quality draft"])
def test_a_whole_token_is_named(name):
    assert missing(MESSAGE, name) == []


@pytest.mark.parametrize("name", ["y.yaml", "x", "capture", "view", "3.5", "-3", 3, 5, 6, 4, "draf"])
def test_a_part_of_a_token_is_not_named(name):
    assert missing(MESSAGE, name) == [str(name)]


def test_another_error_and_another_kind_fail():
    with refused("x.yaml", "views", -3.5):
        raise InputError(MESSAGE)
    with pytest.raises(AssertionError, match="not named"), refused("height"):
        raise InputError(MESSAGE)
    with pytest.raises(AssertionError), refused("views", kind=ValueError):  # a subclass is another kind
        raise InputError(MESSAGE)
    with pytest.raises(ValueError, match="sentence"), refused("views"):
        raise ValueError("some other sentence about views")
    with pytest.raises(pytest.fail.Exception), refused("views"):
        pass


def test_names_alone_are_no_message():
    with pytest.raises(AssertionError, match="no sentence"):
        named("x.yaml: views", "x.yaml", "views")
