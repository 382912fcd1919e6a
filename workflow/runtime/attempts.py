"""Attempts of a job: text that says how the earlier ones ended. The state file of the job holds the facts (`job_state.py`).

A job that is killed says nothing itself. Slurm is asked instead, or the memory with which the job was last seen is reported.
"""

from __future__ import annotations

from collections.abc import Callable
from datetime import datetime
from typing import Any

from iif_core.errors import InputError
from workflow.runtime import alive, slurm

RUN = "IIF_RUN"
"""Variable that names the run of Snakemake that a job belongs to; jobs on other machines inherit it."""
REMEMBERED = 3
"""Largest number of earlier attempts that are reported."""
TIMES = (0.0, 1e11)
"""Seconds since 1970 that can be a time of a job; the last is in the year 5138."""
GUESS = "out of memory, or over its time limit?"


def facts_of(before: dict[str, Any], fingerprint: str, run: str = "") -> dict[str, Any]:
    """Return what is noted of an attempt: its number (`attempt`), its run (`run`), its Slurm job (`slurm`), how those before it
    ended (`earlier`).

    Args:
        before: state that the attempt before has left; empty if that ended well.
        fingerprint: of this attempt; attempts at something else do not count.
        run: of Snakemake; attempts of an earlier run do not count. That run has reported its attempts that failed. An attempt
            that was killed is reported now, because its run may have been killed with it. Empty where no run is known.
    """
    own = slurm.own()
    facts: dict[str, Any] = {"attempt": 1}
    if run:
        facts["run"] = run
    if own:
        facts["slurm"] = own._asdict()
    if before.get("fingerprint") == fingerprint and before.get("run", "") != run:
        if before.get("state") == "started":
            facts["earlier"] = [f"the last one of an earlier run{_place(before)} {ending(before, own)}"]
    elif before.get("fingerprint") == fingerprint:
        number = before.get("attempt", 1)
        facts["attempt"] = number + 1
        ended = f"attempt {number}{_place(before)} {ending(before, own)}"
        facts["earlier"] = [*before.get("earlier", [])[1 - REMEMBERED :], ended]
    return facts


def told(facts: dict[str, Any]) -> str:
    """Describe the earlier attempts that `facts_of` found, and what this one asks for; empty for a first attempt."""
    earlier = facts.get("earlier")
    if not earlier:
        return ""
    asks = _asks(facts.get("slurm", {}))
    number = f"{facts['attempt']}{' of this run' if facts['attempt'] == 1 else ''}"
    return f"attempt {number}{f', which asks for {asks}' if asks else ''}: {'; '.join(earlier)}"


def sound(document: dict[str, Any]) -> dict[str, Any]:
    """Return what of a file of attempts or of a state is of the form that jobs write; whatever else it holds is left out.

    Readers rely on it: on types, on ranges, and on texts that hold nothing which could steer a terminal.
    """
    kept = {key: _FORMS[key](value) for key, value in document.items() if key in _FORMS}
    return {key: value for key, value in kept.items() if value is not None}


def written_out(text: str) -> str:
    """Return a text as messages have it: characters that could steer a terminal are written out, as `InputError` does."""
    return str(InputError(text))


def moment(text: Any) -> float | None:
    """Return a time as a state has it, in seconds as `time.time`; None if it is none, or not within `TIMES`."""
    try:
        found = datetime.fromisoformat(text).timestamp()
    except (TypeError, ValueError, OverflowError, OSError):
        return None
    return found if TIMES[0] <= found <= TIMES[1] else None


def _text(value: Any) -> str | None:
    return written_out(value) if isinstance(value, str) else None


def _texts(value: Any) -> list[str] | None:
    fits = isinstance(value, list) and all(isinstance(line, str) for line in value)
    return [written_out(line) for line in value] if fits else None


def _number(low: int, high: int) -> Callable[[Any], int | None]:
    return lambda value: value if isinstance(value, int) and not isinstance(value, bool) and low <= value <= high else None


def _own(value: Any) -> dict[str, Any] | None:
    if not isinstance(value, dict):
        return None
    asked = {key: value[key] for key in ("memory_mb", "minutes") if value.get(key) is not None}
    texts = [value.get(key) for key in ("job", "node", "log")]
    if not all(isinstance(text, str) for text in texts) or not texts[0].isdecimal():
        return None
    if any(_size(number) is None for number in (value.get("restarts"), *asked.values())):
        return None
    restarts, memory, minutes = value["restarts"], asked.get("memory_mb"), asked.get("minutes")
    return slurm.Own(texts[0], written_out(texts[1]), memory, minutes, restarts, texts[2])._asdict()


_size = _number(0, 10**9)
_FORMS: dict[str, Callable[[Any], Any]] = {
    **dict.fromkeys(("state", "reason", "fingerprint", "run", "host", "kernel", "told"), _text),
    "since": lambda value: value if moment(value) is not None else None,
    "pid": _number(1, 2**31 - 1),
    "start": _number(0, 2**62),
    "attempt": _number(1, 10**6),
    "peak_mb": _size,
    "earlier": _texts,
    "slurm": _own,
}
"""Key of a state -> the value, or None if a job would not write it."""


def ending(document: dict[str, Any], now: slurm.Own | None = None) -> str:
    """Describe how an attempt ended that did not end well.

    Args:
        document: its state file.
        now: the Slurm job of the process that asks; Slurm gives a job that it starts again the same number.
    """
    if document.get("state") == "failed":
        return f"failed: {document.get('reason', '')}"
    own, peak = document.get("slurm"), document.get("peak_mb")
    seen = f"this process had {peak:,} MB when last seen" if peak else ""
    if not own:
        return f"was killed without a word ({GUESS}{f' {seen}' if seen else ''})"
    if now and now.job == own["job"]:
        if now.restarts > own["restarts"]:
            return "was put back into the queue by Slurm (its node failed, or it was preempted or requeued)"
        return f"was killed, but not its Slurm job ({GUESS}{f' {seen}' if seen else ''})"
    asked = _asks(own)
    had = "; ".join(filter(None, (asked and f"it had asked for {asked}", seen)))
    state = slurm.state_of(own["job"])
    if state and state not in slurm.ENDED:
        return f"has not ended: Slurm says {state}"
    cause = state if state in slurm.KILLED and state != "CANCELLED" else slurm.said_in(own["log"], own["job"]) or state
    if cause in slurm.KILLED:
        return slurm.KILLED[cause] + (f": {had}" if had else "")
    full = own.get("memory_mb") and peak and peak > 0.8 * own["memory_mb"]
    guess = "for its memory?" if full else GUESS
    says = f"; Slurm says {state}" if state else ""
    return f"was killed without a word ({guess}{f' {had}' if had else ''}{says})"


def killed(document: dict[str, Any]) -> str:
    """Explain, as far as it can be known, why the state of a job is `started` although its process no longer exists."""
    number, own, earlier = document.get("attempt", 1), document.get("slurm"), document.get("earlier", [])
    if not own and not earlier:
        peak = document.get("peak_mb")
        return f"it was killed ({GUESS}{f' It had {peak:,} MB when last seen' if peak else ''})"
    return "; ".join([*earlier, f"attempt {number}{_place(document)} {ending(document)}"])


def ended_for_slurm(document: dict[str, Any]) -> bool:
    """Return whether Slurm says of a job on another machine that it has ended, which its state file tells minutes later."""
    own = document.get("slurm")
    if not own or alive.lives(document):
        return False
    state = slurm.state_of(own["job"])
    return state in slurm.ENDED


def _place(document: dict[str, Any]) -> str:
    own = document.get("slurm")
    return f" (Slurm job {own['job']} on {own['node']})" if own else ""


def _asks(own: dict[str, Any]) -> str:
    """Describe what a Slurm job asks for; empty outside of Slurm."""
    memory, minutes = own.get("memory_mb"), own.get("minutes")
    limit = minutes and f"{minutes:,} minute{'s' if minutes > 1 else ''}"
    return " and ".join(filter(None, (memory and f"{memory:,} MB", limit)))
