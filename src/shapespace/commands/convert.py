"""Command `convert`: shape models from the formats of other tools to shapespace's own, and on to others."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from shapespace.batch.progress import waiting
from shapespace.commands.look import NOT_CALIBRATED
from shapespace.commands.outcome import Outcome
from shapespace.errors import InputError
from shapespace.formats.model_parts import ModelFormat
from shapespace.formats.registry import MODEL_FORMATS, format_to_write
from shapespace.geometry.articulation import regions_of_parts
from shapespace.geometry.grooming import counts_of_pieces
from shapespace.model.additive import AdditiveModel, load_model, model_of_foreign
from shapespace.model.foreign import OWN_ENDINGS, is_foreign, load_foreign
from shapespace.model.shape_model import ShapeModel
from shapespace.types import MM_PER_UNIT

OWN = ("shapespace", OWN_ENDINGS)


def convert(
    source: Path,
    output: Path,
    *,
    to: str | None = None,
    unit: str | None = None,
    expressions: Path | None = None,
    parts: Sequence[str] = (),
    quiet: bool = False,
) -> Outcome:
    """Write the model in `source` to `output`, and note the data that the new format cannot store.

    Args:
        source: a model in any format that is read.
        output: output file; its extension determines the format unless `to` is given.
        to: format to write, by its name, if the extension of the output does not determine it.
        unit: unit of `source` if its format does not contain it; None for the unit of the format, or mm.
        expressions: blendshapes that eos keeps in a file of their own.
        parts: names of the structures of one subject, such as bones, in a model whose file does not name them: the
            separate pieces of its surface, in the order of their vertices.
        quiet: no progress.

    Raises:
        FileError: `source` cannot be read, or `output` not written.
        InputError: an unknown format, one that is only read, or one that cannot represent the model.
    """
    target, mm = _target_format(output, to), None if unit is None else MM_PER_UNIT[unit]
    if source.resolve() == output.resolve():
        raise InputError(f"{output} is the model itself; give another name to write to.")
    with waiting(f"reading {source.name}", quiet=quiet):
        model, of, notes = _load_model(source, mm, expressions)
        model, left_out = _model_to_write(model, parts)
        linear = model.as_linear()
    notes += left_out
    with waiting(f"writing {output.name}", quiet=quiet):
        if target is None:
            model.save(output)
        else:
            notes += target.write(linear, output)
    shape = model if isinstance(model, ShapeModel) else model.shape
    if target is not None and not shape.is_linear:
        notes.append(
            f"Relative pose is linear in {target.title}: parts that turn by large angles shrink, unlike in the model."
        )
    regions = sorted(set(shape.regions) - set(shape.parts))
    if target is not None and regions:
        notes.append(
            f"Omitted: the region{'' if len(regions) == 1 else 's'} {', '.join(regions)}, which {target.title} has no "
            "place for."
        )
    if "research" in linear.licence.lower() or "non-commercial" in linear.licence.lower():
        notes.append(f"The licence applies to the new file too: {linear.licence.rstrip('.')}.")
    into = OWN[0] if target is None else target.title
    facts = {"source": of, "target": into, "output": str(output), "notes": notes}
    lines = [f"{output} ({into}) contains the model of {source} ({of}).", *(f"  {note}" for note in notes)]
    return Outcome(facts, lines)


def _model_to_write(
    model: ShapeModel | AdditiveModel, parts: Sequence[str]
) -> tuple[ShapeModel | AdditiveModel, list[str]]:
    """Return the model with named `parts`, if any, and without its training shapes, which are not shared, and a
    sentence on that if it had some.
    """
    shape, notes = model if isinstance(model, ShapeModel) else model.shape, list[str]()
    if shape.training is not None:
        notes.append(f"Omitted: {len(shape.training)} training shapes, so {NOT_CALIBRATED}.")
    if parts:
        regions = regions_of_parts(counts_of_pieces(shape.faces, shape.n_vertices, parts))
        shape = replace(shape, regions={**shape.regions, **regions}, parts=tuple(parts))
    shape = replace(shape, training=None)
    return shape if isinstance(model, ShapeModel) else replace(model, shape=shape), notes


def _target_format(output: Path, to: str | None) -> ModelFormat | None:
    named = any(output.name.lower().endswith(tuple(model_format.suffixes)) for model_format in MODEL_FORMATS.values())
    if to == OWN[0] or (to is None and not named and output.suffix.lower() in OWN[1]):
        return None
    return format_to_write(output, to)


def _load_model(
    source: Path, mm: float | None, expressions: Path | None
) -> tuple[ShapeModel | AdditiveModel, str, list[str]]:
    if not is_foreign(source):
        if mm is not None:
            raise InputError(f"{source} is in mm, as all models of shapespace; omit --unit.")
        if expressions is not None:
            raise InputError(f"{source} is a model of shapespace; --expressions goes with the models of eos.")
        return load_model(source), OWN[0], []
    foreign = load_foreign(source, mm, expressions)
    return model_of_foreign(foreign, source), foreign.format, list(foreign.notes)
