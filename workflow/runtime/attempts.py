"""Attempts of a job: how those before it ended, in words. The facts stand in the file of its state (`job_state.py`).

A job that is killed says nothing itself, so Slurm is asked, or what was seen of its memory is told.
"""

from __future__ import annotations

from typing import Any

from workflow.runtime import alive, slurm

REMEMBERED = 3
"""Earlier attempts that are told of."""
GUESS = "out of memory, or over its time limit?"


def facts_of(before: dict[str, Any], fingerprint: str) -> dict[str, Any]:
    """Return what is noted of an attempt: its number (`attempt`), its Slurm job (`slurm`), how those before it ended (`earlier`).

    Args:
        before: state that the attempt before has left; empty if that ended well.
        fingerprint: of this attempt; attempts at something else do not count.
    """
    own = slurm.own()
    facts: dict[str, Any] = {"attempt": 1}
    if own:
        facts["slurm"] = own._asdict()
    if before.get("fingerprint") == fingerprint:
        number = before.get("attempt", 1)
        facts["attempt"] = number + 1
        ended = f"attempt {number}{_place(before)} {ending(before, own)}"
        facts["earlier"] = [*before.get("earlier", [])[1 - REMEMBERED :], ended]
    return facts


def told(facts: dict[str, Any]) -> str:
    """Return in words what `facts_of` found of earlier attempts, and what this one asks for; empty for a first attempt."""
    earlier = facts.get("earlier")
    if not earlier:
        return ""
    asks = _asks(facts.get("slurm", {}))
    return f"attempt {facts['attempt']}{f', which asks for {asks}' if asks else ''}: {'; '.join(earlier)}"


def sound(document: dict[str, Any]) -> dict[str, Any]:
    """Return a state without the facts of attempts that are not of the form that jobs write."""
    own, earlier = document.get("slurm"), document.get("earlier")
    bad = {
        "slurm": not (isinstance(own, dict) and own.keys() >= set(slurm.Own._fields)),
        "earlier": not (isinstance(earlier, list) and all(isinstance(line, str) for line in earlier)),
        "attempt": not isinstance(document.get("attempt"), int),
        "peak_mb": not isinstance(document.get("peak_mb"), int),
    }
    return {key: value for key, value in document.items() if not bad.get(key)}


def ending(document: dict[str, Any], now: slurm.Own | None = None) -> str:
    """Return in words how an attempt ended that did not end well.

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
    """Return in words why a job says `started` and its process is gone, as far as that can be known."""
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
    """Return in words what a Slurm job asks for; empty outside of Slurm."""
    memory, minutes = own.get("memory_mb"), own.get("minutes")
    limit = minutes and f"{minutes:,} minute{'s' if minutes > 1 else ''}"
    return " and ".join(filter(None, (memory and f"{memory:,} MB", limit)))
