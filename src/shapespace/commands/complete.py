"""Command `complete`: a model and partial scans in files to completed surfaces and samples in a folder."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from shapespace.batch.progress import progress
from shapespace.cohort.shape_samples import ENDING
from shapespace.commands.fit import landmark_files, scan_jobs
from shapespace.commands.inputs import expand_part_folders, given_scans, join_specimens
from shapespace.errors import InputError, ShapespaceError
from shapespace.fit.completion.complete import Completion, CompletionConfig, complete, refine_surface
from shapespace.io.containers.archives import write_arrays
from shapespace.io.files import make_folder, remove_file
from shapespace.io.meshes.mesh_io import write_mesh
from shapespace.model.shape_model import ShapeModel
from shapespace.store.corresponding import review_of_provenance


@dataclass(frozen=True)
class CompletionFiles:
    """Input files of completions, and the formats of the output.

    Args:
        landmarks: landmarks of the one scan, or a folder with a file for each scan, named after it.
        recursive: also search subfolders of the given folders.
        stl: also write the surface with four times the triangles, closed where the model is, for CAD (NAME.stl).
    """

    landmarks: Path | None = None
    recursive: bool = False
    stl: bool = False


def complete_scans(
    model_path: Path,
    scans: Sequence[str | Path],
    folder: Path,
    config: CompletionConfig,
    files: CompletionFiles,
    *,
    quiet: bool,
    say: Callable[[str], None],
    on_completion: Callable[[str, Completion], None],
) -> dict[str, str]:
    """Write NAME.ply and NAME.samples.npz of each scan into `folder`; return NAME -> reason for scans that failed.

    Args:
        model_path: file of the model.
        scans: files, folders, patterns, addresses and lists, see `fit`.
        folder: folder of the results.
        config: settings.
        files: landmarks, and the formats of the output.
        quiet: no progress.
        say: called with messages on skipped files and on scans that failed.
        on_completion: called with NAME and completion of each scan.

    Raises:
        FileError: the model cannot be read, or the results not written.
        InputError: one file of landmarks for more than one scan, or no scans.
    """
    model = ShapeModel.load(model_path)
    scans = expand_part_folders(scans, model.parts)
    given = join_specimens(given_scans(scans, folder, recursive=files.recursive, say=say), model.parts)
    one, many = landmark_files(files.landmarks, len(given))
    if review := review_of_provenance(model.provenance):
        say(f"{model_path}: of its training surfaces, {review}.")
    make_folder(folder)
    jobs = scan_jobs(given, one, many, folder)
    failed: dict[str, str] = {}
    with progress(len(jobs), "completing", "scan", quiet=quiet) as bar:
        for job in jobs:
            paths = {ending: folder / f"{job.name}{ending}" for ending in (".ply", ENDING, ".stl")}
            if job.scan.resolve() in {path.resolve() for path in paths.values()}:
                raise InputError(f"{job.scan} would be overwritten by its completion; give another output folder.")
            for path in paths.values():  # results of an earlier run would contradict a failure
                remove_file(path)
            try:
                with job.readable() as file:
                    scan = job.read(file)
                own = replace(config, fit=config.fit.for_scan(model, job.name))
                completion = complete(model, scan, own, landmarks=job.landmarks)
            except ShapespaceError as error:
                if isinstance(error, InputError) and len(jobs) > 1 and not bar.counted:
                    raise  # of the model and the settings, and therefore of all scans
                failed[job.name] = str(error)
                bar.clear()
                say(str(error))
            else:
                write_arrays(
                    paths[ENDING],
                    {
                        "vertices": completion.draw_samples(),
                        "knowledge": completion.knowledge,
                        "stddev_mm": completion.stddev_mm.astype(np.float32),
                    },
                )
                if files.stl:
                    write_mesh(paths[".stl"], refine_surface(completion))
                write_mesh(paths[".ply"], completion.surface())
                on_completion(job.name, completion)
            bar.update()
    many.report_unused(say)
    return failed
