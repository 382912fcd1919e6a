"""The table of commands of `python -m workflow`: what each takes, and that nothing in it is out of reach."""

import pytest

from workflow import __main__ as commands


def parsed(monkeypatch, *words):
    monkeypatch.setattr("sys.argv", ["workflow", *words])
    return commands._arguments()


def test_only_the_scattered_stage_takes_parts(monkeypatch, capsys):
    assert parsed(monkeypatch, "prior", "a", "--part", "1-of-2").part == "1-of-2"
    with pytest.raises(SystemExit):
        parsed(monkeypatch, "base", "a", "--part", "1-of-2")
    assert "--part" in capsys.readouterr().err


def test_defaults_of_options(monkeypatch):
    stage = parsed(monkeypatch, "base", "a")
    assert (stage.quality, stage.threads, stage.fingerprint, stage.log) == ("draft", 2, None, None)
    assert parsed(monkeypatch, "score", "a", "maps").colour == "auto" and parsed(monkeypatch, "relit", "a").plan == ""
    assert parsed(monkeypatch, "status").scenes == [] and not parsed(monkeypatch, "batch").over


def test_every_word_belongs_to_a_command():
    assert {word for command in commands.COMMANDS.values() for word in command.words.split()} == set(commands.WORDS)


@pytest.mark.parametrize("command", ["status", "verify"])
def test_commands_that_only_look_start_no_libraries(monkeypatch, command):
    seen = []
    looking = commands.COMMANDS[command]._replace(run=lambda found: seen.append(found) or 0)
    monkeypatch.setitem(commands.COMMANDS, command, looking)
    monkeypatch.setattr("workflow.runtime.native.prepare", lambda: 1 / 0)
    monkeypatch.setattr("sys.argv", ["workflow", command, "a"])
    assert commands.main() == 0 and seen[0].scenes == ["a"]
