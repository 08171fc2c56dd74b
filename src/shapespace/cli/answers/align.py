"""`shapespace align`: generalised Procrustes analysis of landmarks."""

from __future__ import annotations

import argparse

from shapespace.cli.answers.common import column_value
from shapespace.cli.options import given
from shapespace.cli.printing import say, show, show_json


def run(arguments: argparse.Namespace) -> int:
    """Align landmarks, and name the specimens to check."""
    from shapespace.commands.align import align
    from shapespace.geometry.landmark_alignment import AlignConfig
    from shapespace.report.blocks.wording import counted
    from shapespace.schemas import to_json

    config = AlignConfig(**given(arguments, AlignConfig))
    reflect = column_value(arguments.reflect, "--reflect") if arguments.reflect else None
    _, record = align(arguments.data, arguments.output, config, **given(arguments, align, reflect=reflect))
    for note in record.notes:
        say(note)
    if arguments.json:
        show_json({"folder": str(arguments.output), **to_json(record)})
    else:
        show(f"{record.specimens} specimens with {record.landmarks} landmarks ({record.dimensions}-D) are aligned.")
        check = len({finding.specimen for finding in record.findings})
        show(f"{counted(check, 'specimen')} to check." if check else "No outliers, swaps or mirrored specimens.")
        show(f"Results are in {arguments.output}")
    return 0
