"""All bounds on what visitors and strangers can use of the machine that a viewer runs on."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Limits:
    """What a viewer takes.

    Args:
        upload_bytes: largest scan.
        all_bytes: of all scans and questions that are being received, wait for their fit, or are kept for landmarks.
        question_bytes: largest request that is no scan.
        body_s: seconds that a scan or a question may take to arrive,
        stalled_s: and for which nothing of it may come.
        fits_at_once: of all visitors; more wait in a queue.
        unfinished: fits that one visitor may have running or waiting.
        kept: fitted scans that one visitor may keep; the oldest go.
        visitors: that have scans; a scan of one more is refused.
        onlookers: visitors without any; the one idle for longest goes.
        fit_s: seconds that a fit may take.
        idle_s: seconds without a request after which a visitor's scans are removed.
        unwatched_s: seconds after which a fit that nobody watches is stopped.
        connections: at a time; one more takes the place of the one without a request for longest.
        quiet_s: seconds that a connection may be without a request, and that an answer may wait to be taken.
        guesses: wrong tokens in a row; the next is looked at after `guess_s`.
        guess_s: seconds after which one more token is looked at.
        ticket_s: seconds for which the address that opens the browser is good.
    """

    upload_bytes: int = 200 * 2**20
    all_bytes: int = 2 * 2**30
    question_bytes: int = 2**20
    body_s: float = 600.0
    stalled_s: float = 20.0
    fits_at_once: int = 2
    unfinished: int = 3
    kept: int = 8
    visitors: int = 100
    onlookers: int = 1000
    fit_s: float = 600.0
    idle_s: float = 1800.0
    unwatched_s: float = 20.0
    connections: int = 128
    quiet_s: float = 30.0
    guesses: int = 20
    guess_s: float = 1.0
    ticket_s: float = 60.0
