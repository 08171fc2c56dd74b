"""What `fit` does: a model and scans in files to result files in a folder."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from tqdm import tqdm

from shapespace.batch.executors import Where
from shapespace.batch.fit_work import Job
from shapespace.batch.folder import RECORD
from shapespace.batch.progress import progress, telling_of_compiling
from shapespace.batch.run import Plan, fit_files, make_jobs
from shapespace.errors import InputError
from shapespace.fit.fit import FitConfig
from shapespace.fit.state import IcpState
from shapespace.io.files import make_folder, remove_file, write_bytes
from shapespace.io.folders import mesh_files
from shapespace.model.shape_model import ShapeModel

_SURFACES = (".fitted.ply", ".dense.ply")


@dataclass(frozen=True)
class BatchSettings:
    """How many scans are fitted.

    Args:
        config: settings of each fit.
        landmarks: of the one scan there is, or None.
        where: they are fitted.
        again: fit also scans whose results still hold.
        stages: also write the surfaces at each stage.
        recursive: take scans in folders below those given too.
    """

    config: FitConfig = field(default_factory=FitConfig)
    landmarks: Path | None = None
    where: Where = field(default_factory=Where)
    again: bool = False
    stages: bool = False
    recursive: bool = False


def fit_scans(
    model_path: Path,
    scans: Sequence[Path],
    folder: Path,
    settings: BatchSettings,
    *,
    quiet: bool,
    say: Callable[[str], None],
) -> dict[str, dict[str, Any]]:
    """Fit scans from files into `folder`, and return NAME -> record of each, in order.

    Args:
        model_path: the model's file.
        scans: files and folders.
        folder: where results go.
        settings: how.
        quiet: no progress.
        say: told what was not taken, and of each scan whose fit did not converge.

    Raises:
        FileError: the model cannot be read, or the results not written.
        InputError: landmarks for more than one scan, or no scans.
    """
    files = _scans(scans, folder, recursive=settings.recursive, say=say)
    if settings.landmarks is not None and len(files) > 1:
        raise InputError("--landmarks belongs to one scan, but several were given; fit them one at a time.")
    model = ShapeModel.load(model_path)
    make_folder(folder)
    write_bytes(folder / ".writable", b"")
    remove_file(folder / ".writable")
    work = list({job.name: job for job in make_jobs(files, settings.landmarks, folder)}.values())
    if len(work) < len(files):
        say(f"Scans given more than once are fitted once: {len(work)} of {len(files)}.")
    with progress(len(work), "fitting", "scan", quiet=quiet) as bar:
        records = _fit(work, model, model_path, folder, settings, _Watch(bar, say), quiet=quiet)
    return {job.name: record for job, record in zip(work, records, strict=True)}


@dataclass(frozen=True)
class _Watch:
    """Shows how the fits go, and says which did not converge."""

    bar: tqdm[Any]
    say: Callable[[str], None]

    def state(self, state: IcpState) -> None:
        self.bar.set_postfix_str(f"phase {state.phase}, iteration {state.iteration}, RMS {state.rms_mm:.2f} mm")

    def plan(self, plan: Plan) -> None:
        for sentence in plan.sentences():
            self.say(sentence)

    def done(self, job: Job, record: Mapping[str, Any]) -> None:
        self.bar.update()
        if record["status"] == "converged":
            return
        self.bar.clear()
        # The reason of a failure names the file already.
        failed = record["status"] == "failed"
        self.say(record["reason"] if failed else f"{job.scan}: {record['status']}: {record['reason']}")


def _fit(
    work: Sequence[Job],
    model: ShapeModel,
    model_path: Path,
    folder: Path,
    settings: BatchSettings,
    watch: _Watch,
    *,
    quiet: bool,
) -> list[dict[str, Any]]:
    executor = settings.where.executor(len(work), quiet=quiet)
    with telling_of_compiling(quiet=quiet or executor is not None):
        return fit_files(
            work, model, model_path, folder, settings.config, executor=executor, resume=not settings.again,
            stages=settings.stages, on_plan=watch.plan, on_done=watch.done, on_state=watch.state,
        )  # fmt: skip


def _scans(scans: Sequence[Path], folder: Path, *, recursive: bool, say: Callable[[str], None]) -> list[Path]:
    """Return the files to fit: without the surfaces that earlier runs left, where scans and results mix."""
    found = mesh_files(scans, recursive=recursive, apart_from=folder)
    for sentence in found.left_out:
        say(sentence)
    here = folder.resolve()
    given = {path.resolve() for path in scans}

    def is_result(scan: Path) -> bool:
        name = next((scan.name.removesuffix(ending) for ending in _SURFACES if scan.name.endswith(ending)), None)
        if name is None or not scan.with_name(f"{name}{RECORD}").is_file():
            return False
        return scan.parent.resolve() == here or not {scan.resolve(), scan.parent.resolve()} & given

    left = [scan for scan in found.files if not is_result(scan)]
    if not left:
        raise InputError(f"{folder} holds only results of earlier fits; give the scans, or another folder for results.")
    if len(left) < len(found.files):
        results = len(found.files) - len(left)
        what = "1 surface of an earlier fit is" if results == 1 else f"{results} surfaces of earlier fits are"
        say(f"{what} not taken for a scan." if results == 1 else f"{what} not taken for scans.")
    return left
