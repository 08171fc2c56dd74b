"""Output of the command line: sentences on standard error, lines and JSON on standard output."""

from __future__ import annotations

import json
import sys

from shapespace.commands.outcome import Aside, Outcome, plain_value


def say(sentence: str) -> None:
    """Print a sentence on standard error."""
    print(_escape_control(sentence), file=sys.stderr)


def warn(sentence: str) -> None:
    """Print a sentence on standard error, with the name of the program."""
    say(f"shapespace: {sentence}")


def show(line: str) -> None:
    """Print a line on standard output."""
    print(_escape_control(line))


def now(line: str) -> None:
    """Print a line at once, for a command that continues."""
    show(line)
    sys.stdout.flush()


def show_outcome(outcome: Outcome, *, as_json: bool) -> int:
    """Print the outcome of a command, open its page, and return its exit code."""
    for note in outcome.notes:
        say(note)
    if as_json:
        facts = outcome.facts() if callable(outcome.facts) else outcome.facts
        print(json.dumps(plain_value(facts), indent=1, allow_nan=False))
    else:
        for line in outcome.lines:
            (say if isinstance(line, Aside) else show)(line)
    for error in outcome.errors:
        say(error)
    if outcome.page is not None:
        import webbrowser  # loads much

        webbrowser.open(outcome.page.absolute().as_uri())
    return outcome.exit_code


def _escape_control(line: str) -> str:
    """Return `line` with control characters as escapes: names of files may contain line breaks and terminal codes."""
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode("ascii") for c in line)
