"""What `correspond` does: it brings scans into correspondence, or changes a finished correspondence."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

from shapespace.batch.execution import ExecutionConfig
from shapespace.commands.correspond import CorrespondFiles, correspond_files, correspond_groups
from shapespace.commands.correspond_changes import Change, change_correspondence
from shapespace.commands.outcome import Aside, Outcome, first_lines
from shapespace.correspondence.settings import CorrespondConfig
from shapespace.errors import InputError
from shapespace.schemas import CorrespondenceRecord, CorrespondRecord, SurfaceReview, to_json
from shapespace.store.review_text import describe_review, review_summary


def correspond(
    scans: Sequence[str | Path],
    output: Path,
    config: CorrespondConfig,
    change: Change,
    execution: ExecutionConfig,
    *,
    template: Path | None,
    model: Path | None,
    landmarks: Path | None,
    subjects: str | None,
    groups: bool,
    recursive: bool,
    strict: bool,
    quiet: bool,
    say: Callable[[str], None],
) -> Outcome:
    """Bring scans into correspondence, or change a finished correspondence.

    Args:
        scans: files, folders, patterns, addresses and lists of these.
        output: where results go, or the finished correspondence.
        config: settings.
        change: what is changed.
        execution: Executor of the registrations.
        template: see `CorrespondFiles`, as for the following.
        model: to begin with.
        landmarks: a folder of files that are named as the scans.
        subjects: column of the list of scans.
        groups: bring each kind of object into correspondence.
        recursive: take scans in folders below those given too.
        strict: exclude scans with non-finite coordinates.
        quiet: no progress.
        say: called with each message.

    Raises:
        FileError: something cannot be read or written.
        InputError: options that do not go together, or too few scans.
    """
    if change and groups:
        raise InputError(f"--groups cannot be combined with {change.option}; leave one of them out.")
    if subjects and (change or groups):
        other = change.option if change else "--groups"
        raise InputError(f"--subjects cannot be combined with {other}; leave one of them out.")
    if not (change or scans):
        raise InputError("Give scans, or a change of a finished correspondence by --redo, --remove or --update.")
    files = CorrespondFiles(scans, template, model, landmarks, execution, recursive, strict, subjects)
    if change:
        summary, records = change_correspondence(change, files, output, config, quiet=quiet, say=say)
    else:
        bring = correspond_groups if groups else correspond_files
        summary, records = bring(files, output, config, quiet=quiet, say=say)
    facts = {"folder": str(output), **to_json(summary), "records": to_json(records)}
    return Outcome(facts, _lines(summary, records, output), exit_code=int(bool(summary.set_aside)))


def _needs_review(record: CorrespondRecord) -> list[str]:
    return [f"{record.name} needs review: {'; '.join(describe_review(record))}"]


def _lines(summary: CorrespondenceRecord, records: Sequence[CorrespondRecord], folder: Path) -> list[str]:
    rounds = [
        f"round {number}: vertices moved by {100 * moved:.2f} % of the size (RMS)"
        for number, moved in enumerate(summary.rounds, 1)
    ]
    warnings = [
        f"{record.name} is {'excluded' if record.reason else 'doubtful'}: {record.reason or record.doubt}"
        for record in records
        if record.reason or record.doubt
    ]
    there = [record for record in records if not record.reason]
    unusual = [record for record in there if record.review and not record.doubt]
    warnings += first_lines(unusual, _needs_review, "more surfaces need review")
    seen = sum(record.seen_share or 0.0 for record in there) / len(there)
    doubtful = sum(bool(record.doubt) for record in there)
    total = (
        f"{len(there)} of {len(records)} scans in correspondence{f' ({doubtful} doubtful)' if doubtful else ''}, "
        f"{summary.vertices} vertices, of which a scan shows {100 * seen:.1f} % on average; results in {folder}"
    )
    review = review_summary(SurfaceReview.of(record.review_codes for record in there))
    reviewed = [f"{review}; inspect them with shapespace report {folder}"] if review else []
    asides = [Aside(f"shapespace: {warning}") for warning in warnings]
    return [summary.template, *rounds, *asides, total, *reviewed, f"next: shapespace build {folder} -o model.h5"]
