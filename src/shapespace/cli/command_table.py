"""All commands: their examples, their options, and the functions that run them.

An option with a source takes its help, type, choices and default from the field of that class or function.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from shapespace.cli import values
from shapespace.cli.options import Option, Source, advanced, basic, setting
from shapespace.statistics.shape_tests.test_table import SHAPE_TESTS, ShapeTest

# The classes and functions that options are read from.
COHORT = Source("cohort.read", "CohortConfig")
ALIGN = Source("geometry.landmark_alignment", "AlignConfig")
ALIGN_FILES = Source("commands.align", "align")
EXECUTION = Source("batch.executors", "ExecutionConfig")
CORRESPOND = Source("correspondence.settings", "CorrespondConfig")
CHANGE_CORRESPONDENCE = Source("commands.correspond_changes", "Change")
BUILD = Source("model.build_model", "BuildConfig")
BUILD_FILES = Source("commands.build", "BuildFilesConfig")
QUALITY = Source("model.model_quality", "QualityConfig")
QUALITY_TARGETS = Source("commands.quality", "QualityOptions")
FIT = Source("fit.fit_scan", "FitConfig")
COMPLETION = Source("fit.completion.complete", "CompletionConfig")
COMPLETION_FILES = Source("commands.complete", "CompletionFiles")
PAPER = Source("fit.paper.paper_method", "Paper")
IDENTITY = Source("statistics.identity.trial", "IdentityConfig")
FIGURES = Source("report.pages.write_html", "FigureConfig")
COMPARE = Source("statistics.compare_shapes", "CompareConfig")
MORPHOSPACE = Source("statistics.shape_tests.ordination", "ordinate")
CHANGE = Source("statistics.change_result", "ChangeConfig")
ASYMMETRY = Source("statistics.asymmetry", "measure_asymmetry")
REGRESS = Source("statistics.regression", "regress")
ALONG = Source("statistics.shape_prediction", "predict_shapes")
SCORE = Source("statistics.score_subjects", "ScoreConfig")
DEMO = Source("demo", "run_demo")
FACES = Source("commands.data", "write_simulated_faces")
ORGANS = Source("commands.data", "write_simulated_organs")
BONES = Source("commands.data", "write_simulated_bones")
JOINTS = Source("commands.data", "write_simulated_joints")
SKULLS = Source("commands.data", "write_simulated_landmarks")
SURFACE = Source("commands.surface", "write_surfaces")
GROOMING = Source("geometry.grooming", "Grooming")
LANDMARKS_TRANSFER = Source("commands.landmarks", "transfer_landmarks")
LANDMARKS = Source("commands.landmarks", "suggest_specimens")
LANDMARKS_CONVERT = Source("commands.landmark_data", "convert_landmarks")
LANDMARKS_PLOT = Source("commands.landmark_data", "plot_configurations")
TRAIN = Source("commands.recognise", "recognise_train")
STUDY = Source("commands.recognise", "recognise_study")
VIEW = Source("viewer.serve", "serve")
STUDIO = Source("viewer.serve", "serve_studio")
EXPORT = Source("commands.export", "export")
EXPORT_COHORT = Source("commands.export", "export_cohort")
CONVERT = Source("commands.convert", "convert")

_UNITS = ("um", "mm", "cm", "inch", "m")
_ABOUT_MESHES = "kept in the model file (default: that in about.json next to the meshes)"
_REPRESENTATIONS = ("vertices", "bspline", "bspline-detail")
_FOR_FORMS: Mapping[str, Any] = {"commands": lambda: summaries_and_options()}
_GOES_ON: Mapping[str, Any] = {"goes_on": "; the same command continues from there"}

GROUPS: Mapping[str, str] = {
    "data": "open data sets, and simulated faces, organs, bones and landmarks",
    "landmarks": "convert, check and plot landmarks; transfer them from marked specimens to scans in correspondence",
    "test": "tests of shape beyond linear models: disparity, covariation, phylogeny, equivalence",
    "recognise": "classify scans (for example, facial expressions) by fitted coefficients",
}
"""Commands that consist of subcommands."""


@dataclass(frozen=True)
class CommandSpec:
    """A command.

    Args:
        name: words of the command after `shapespace`.
        summary: summary of the task, without a capital and a full stop.
        examples: command lines.
        run: module and name of the function that runs it, see `cli.dispatch.run_command`.
        arguments: arguments in the order of the help.
        details: paragraphs on the files that it reads and writes, for `--help-all` and the reference.
        json: whether it prints facts, with `--json`.
        defaults: further attributes of the parsed arguments.
        settings: values that are rarely changed, given as `--set NAME=VALUE`.
        has_workers: whether it reads many scans in worker processes, which load their code while the command starts.
    """

    name: str
    summary: str
    examples: tuple[str, ...]
    run: str
    arguments: tuple[Option, ...] = ()
    details: tuple[str, ...] = ()
    json: bool = True
    defaults: Mapping[str, Any] = field(default_factory=dict[str, Any])
    settings: tuple[Option, ...] = ()
    has_workers: bool = False

    @property
    def options(self) -> tuple[Option, ...]:
        """All arguments, including those of every command."""
        return (*self.arguments, *((SET,) if self.settings else ()), *((JSON,) if self.json else ()), QUIET)

    @property
    def usage(self) -> str:
        """The command line with the required arguments."""
        endings = {"+": "...", "*": "...]", "?": "]"}
        words = ["shapespace", self.name]
        for option in self.options:
            if option.is_positional:
                start = "[" if option.nargs in ("*", "?") else ""
                words.append(f"{start}{option.metavar}{endings.get(option.nargs or '', '')}")
        needed: dict[str, list[str]] = {}
        for option in self.options:
            if option.required:
                needed.setdefault(option.either or option.names, []).append(f"{option.spellings[0]} {option.metavar}")
        words += [f"({' | '.join(either)})" if len(either) > 1 else either[0] for either in needed.values()]
        return " ".join([*words, "[options]"])


QUIET = basic("--quiet", help="do not show progress")
JSON = basic("--json", help="print the results as JSON")
SET = advanced("--set", "NAME=VALUE", "a value that is rarely changed, from the list of settings; can be repeated",
               repeat=True)  # fmt: skip
_OUTPUT = basic("-o --output", "DIR", "output folder", parse=Path, required=True)
_MARKED = basic("marked", "MARKED", "folder of landmark files with the names of the scans, in any landmark format",
                parse=Path)  # fmt: skip
_LANDMARK_DATA = basic("data", "DATA", "file or folder with the landmarks of many specimens", parse=Path)
_SLIDERS = basic("--sliders", "FILE.csv", source=LANDMARKS_CONVERT, parse=Path, repeat=True, default=[])
_SAME = basic("scans", "SAME", "folder that correspond wrote", parse=Path)
_RECURSIVE = advanced("--recursive", help="also search subfolders of the given folders")
_STRICT_HELP = (
    "reject scans with coordinates that are NaN or infinite (default: remove the triangles that use them, with a note)"
)
_NO_OPEN = advanced("--no-open", help="do not open the report in a browser")
_MODEL_OF_FITS = advanced("--model", "MODEL.h5", "model file of the fits, if it was moved", parse=Path)
_RESULTS = basic("results", "RESULTS", "a folder that fit wrote, or its coefficients.csv", parse=Path)
_IDENTITY_RULES = (
    "Scans are compared by the coefficients of their fits. DATA is a table or a folder of fits, see compare, change, "
    "asymmetry, regress and score."
)
_MODES, _TARGET = "modes", "target"
_CHANGE = "change"


_FIT_OPTIONS = (
    advanced("--scale", source=FIT),
    advanced("--crop", "KIND:NUMBERS", source=FIT),
)
"""Options of the fit that `fit` and `complete` share."""
_LANDMARK_STDDEV = setting("landmark_stddev_mm", "MM", source=FIT, parse=values.std_mm)
_EXECUTION_SETTINGS = (
    setting("executor", "", "local: processes on this machine; serial: one after the other in this process; dask: "
            "a Dask cluster", EXECUTION, "kind", choices=("local", "serial", "dask")),
    setting("dask", "ADDRESS", "address of a Dask scheduler, such as tcp://10.0.0.5:8786, or its scheduler file "
            "(.json); without it executor=dask starts a cluster on this machine", EXECUTION),
    setting("timeout", "S", "time limit of a scan, fit or fold, s; those that take longer are skipped (default: no "
            "limit)", EXECUTION, "timeout_s", parse=values.seconds),
)  # fmt: skip


def _jobs_option(what: str) -> Option:
    """Return the option of parallel runs; `what` is run."""
    return basic("--jobs", "N", f"{what} in parallel (default: one per core)", EXECUTION)


COHORT_SETTINGS = (
    setting("model", "MODEL.h5", source=COHORT),
    setting("surfaces", source=COHORT),
    setting("geometry", source=COHORT),
    setting("gauge", source=COHORT),
    setting("unit", source=COHORT),
    setting("doubtful", source=COHORT),
    setting("missing", source=COHORT),
    setting("imputations", "M", source=COHORT),
    setting("subject", "COLUMN", source=COHORT),
    setting("landmarks", "FILE", source=COHORT),
    setting("orientation", "FILE", source=COHORT),
)
"""Settings of a cohort, which a cohort file contains."""
_BASIC_OF_COHORT = ("surfaces", "geometry", "gauge", "doubtful", "missing", "subject")
"""Settings that `shapespace cohort --help` lists."""
_SHAPES = basic("--shapes", "DIR|FILE", source=COHORT)
_DATA = basic(
    "data", "DATA", "a table (CSV or .xlsx) with one row per shape, named in the column file, scan, specimen, name or "
    "id; a cohort file (.toml); a folder of fits, whose metadata are the table; a folder that align wrote; or a "
    "landmark file", parse=Path,
)  # fmt: skip
_COHORT = (_DATA, _OUTPUT, _SHAPES)
"""Arguments of a question: its cohort, and the output folder."""


def _question_settings(*own: Option, without: tuple[str, ...] = ()) -> tuple[Option, ...]:
    """Return the settings of a question: its own, and those of its cohort `without` some names."""
    return (*own, *(option for option in COHORT_SETTINGS if option.names not in without))


_IDENTITY_OPTIONS = (
    *_COHORT,
    basic("--gallery", "EXPR", source=IDENTITY),
    basic("--probe", "EXPR", source=IDENTITY),
    advanced("--train", "EXPR", source=IDENTITY),
    advanced("--scores", "LIST", source=IDENTITY),
    advanced("--modes", "K", source=IDENTITY),
)
_IDENTITY_SETTINGS = _question_settings(
    setting("role", "COLUMN", source=IDENTITY),
    setting("folds", "N", source=IDENTITY),
    setting("uncertainty", source=IDENTITY),
    setting("draws", "N", source=IDENTITY),
    setting("seed", "S", source=IDENTITY),
    without=("gauge", "unit"),
)


_BASIC_OF_TEST = 4
"""First options of a test that `--help` lists, in addition to those of all tests."""


def _shape_test(test: ShapeTest) -> CommandSpec:
    """Return the command of a test of shape."""
    module, _, function = test.function.partition(".")
    source = Source(f"statistics.shape_tests.{module}", function)
    own = tuple(
        Option(
            f"--{field.replace('_', '-')}",
            metavar,
            source=source,
            field=field,
            required=field in test.required,
            basic=number < _BASIC_OF_TEST,
        )
        for number, (field, metavar) in enumerate(test.options.items())
    )
    return CommandSpec(
        f"test {test.name}", test.summary, (test.example,), "cli.answers:answer_shape_tests",
        (
            *_COHORT,
            *own,
            basic("--permutations", "N", source=source, parse=values.positive),
        ),
        defaults={"shape_test": test},
        settings=_question_settings(setting("seed", "S", source=source)),
    )  # fmt: skip


COMMANDS: tuple[CommandSpec, ...] = (
    CommandSpec(
        "demo",
        "run both experiments of the paper on simulated faces, ending in a report", ("shapespace demo --quick",),
        "commands.demo:demo",
        (
            basic("-o --output", "DIR", "output folder; results of an earlier demo in it are replaced",
                  default=Path("shapespace-demo"), parse=Path, dest="out"),
            basic("--quick", source=DEMO),
            basic("--no-open", help="do not open the report in a browser"),
        ),
        (
            "Writes report.html and demo.json (settings, versions, times, the table of the paper's and the measured "
            "values); in experiment1 and experiment2 the models, the scans, and the results of their fits as fit "
            "--stages writes them. The scan of James is used if the data set is present. Needs the extra report.",
        ),
    ),
    CommandSpec("data list",
            "list the open data sets: licence, citation, source, size, hash", ("shapespace data list",),
            "commands.data:data_list"),
    CommandSpec(
        "data get", "download, verify and convert an open data set", ("shapespace data get ict-facekit",),
        "commands.data:data_get",
        (
            basic("name", "NAME", "name of the data set, as data list prints it"),
            basic("--to", "DIR", "also copy it to DIR/NAME", parse=Path),
        ),
    ),
    CommandSpec(
        "data faces", "write simulated corresponding faces (PLY) with labels.csv",
        ("shapespace data faces -o faces --subjects 100 --expressions neutral",), "commands.data:write_simulated_faces",
        (
            _OUTPUT,
            basic("--subjects", "N", source=FACES, parse=values.positive),
            basic("--expressions", "LIST", source=FACES, parse=values.words),
            basic("--raw", source=FACES),
            basic("--seed", "S", source=FACES),
            advanced("--source", source=FACES, choices=("bundled", "ict-facekit")),
            advanced("--area", source=FACES, choices=("face", "face_and_head")),
            advanced("--wide", source=FACES),
            advanced("--intensity", "LIST", source=FACES, field="intensities", parse=values.shares),
            advanced("--effect", "MM", source=FACES, field="effect_mm"),
        ),
        (
            "Writes one PLY per subject and expression, labels.csv, landmarks.csv, and about.json with provenance and "
            "licence, which build reads.",
        ),
    ),
    CommandSpec(
        "data organs", "write simulated organs, smooth as spleens: raw surfaces (PLY), or label volumes",
        ("shapespace data organs -o organs --count 40",), "commands.data:write_simulated_organs",
        (
            _OUTPUT,
            basic("--count", "N", source=ORGANS, parse=values.positive),
            basic("--volumes", source=ORGANS),
            basic("--seed", "S", source=ORGANS),
        ),
        ("Each organ is closed, in mm, with its own triangles and pose; the surfaces are not in correspondence.",),
    ),
    CommandSpec(
        "data bones", "write simulated bones of two groups: raw scans (PLY), and their table bones.csv",
        ("shapespace data bones -o bones --count 16",), "commands.data:write_simulated_bones",
        (
            _OUTPUT,
            basic("--count", "N", source=BONES, parse=values.positive),
            basic("--effect", "MM", source=BONES, field="effect_mm"),
            basic("--seed", "S", source=BONES),
        ),
        (
            "The bones are small skulls, in mm, each with its own triangles and pose; every third scan has a hole. "
            "bones.csv has the columns file and group.",
        ),
    ),
    CommandSpec(
        "data joints", "write simulated joints: raw scans of two bones per subject (PLY), and their table joints.csv",
        ("shapespace data joints -o knees --count 16",), "commands.data:write_simulated_joints",
        (
            _OUTPUT,
            basic("--count", "N", source=JOINTS, parse=values.positive),
            basic("--effect", "DEGREES", source=JOINTS, field="effect_degrees"),
            basic("--seed", "S", source=JOINTS),
        ),
        (
            "The bones of a subject, NAME_femur.ply and NAME_tibia.ply, are in one frame, in mm. joints.csv has the "
            "columns specimen and group; the flexion of the second group is larger.",
        ),
    ),
    CommandSpec(
        "data landmarks", "write simulated landmarks of skulls (TPS, 2-D) of two species, and their table skulls.csv",
        ("shapespace data landmarks -o skulls",), "commands.data:write_simulated_landmarks",
        (
            _OUTPUT,
            basic("--count", "N", source=SKULLS, parse=values.positive),
            basic("--seed", "S", source=SKULLS),
        ),
        (
            "skulls.tps has 12 landmarks per specimen in pixels with its scale in mm per pixel; links.csv has the "
            "lines between landmarks of an outline.",
        ),
    ),
    CommandSpec(
        "surface", "extract surfaces of labels from label volumes (NIfTI, NRRD), as PLY in LPS mm",
        ("shapespace surface masks -o surfaces --label 1", "shapespace fit model.h5 surfaces -o out --unit mm"),
        "commands.surface:write_surfaces",
        (
            basic("volumes", "MASK", "label volumes, or folders of them", nargs="+", parse=Path),
            basic("-o --output", "DIR", "output folder; each surface is NAME.ply", parse=Path, required=True),
            basic("--label", "N|NAME|N,N|all", source=SURFACE, field="labels", parse=str),
            basic("--smooth", "S", source=SURFACE, parse=values.smoothing),
            advanced("--recursive", source=SURFACE),
            advanced("--keep-pieces", source=SURFACE),
            advanced("--max-memory", "SIZE", source=SURFACE, field="max_memory_bytes", parse=values.memory_bytes),
        ),
        (
            "NAME is the name of the volume without its ending, with as much of the path as distinguishes volumes of "
            "the same name. A volume that cannot be used is reported, a surface of that NAME from an earlier run is "
            "removed, and the others are processed. Needs the extra volumes.",
        ),
    ),
    CommandSpec(
        "check",
        "check meshes: contents, defects, and their repair before a fit",
        ("shapespace check scan.obj", "shapespace check left_bones -o mirrored --mirror --unit cm",
         "shapespace check skulls -o groomed --outer --largest --fill-holes 30",
         "shapespace check template.ply -o symmetric --symmetric"), "commands.look:check",
        (
            basic("files", "FILE", "mesh files, or folders of them", nargs="+", parse=Path),
            basic("-o --output", "DIR", "output folder for the repaired meshes in mm, as NAME.ply", parse=Path),
            basic("--unit", "UNIT", "unit of the files, for -o (default: mm)", choices=_UNITS),
            basic("--crop", "KIND:NUMBERS", source=GROOMING, parse=str, repeat=True, default=[]),
            basic("--outer", source=GROOMING),
            basic("--largest", source=GROOMING),
            basic("--fill-holes", "N", source=GROOMING, parse=values.positive),
            basic("--mirror", help="write mirror images, such as of left bones among right ones"),
            advanced("--symmetric", help="write symmetric meshes, as templates: the mean of each mesh and its mirror "
                     "image, with vertices in left and right pairs and on the midline"),
            advanced("--recursive", help="also search subfolders of the given folders"),
            advanced("--strict", help=_STRICT_HELP),
        ),
        (
            "With -o, a mesh is repaired, then cropped, reduced to its outer surface and to its largest piece, and its "
            "holes are filled, in this order, if these options are given. None of this moves a vertex. --unit "
            "multiplies the coordinates by the length of the unit in mm, and --mirror reflects them at x = 0; without "
            "both, the written coordinates are exactly those of the file, so that landmarks on the scan stay valid.",
            "The report of a file lists defects that a fit repairs (fixed), notes, and defects that make the file "
            "unusable. The exit code is 0 if all files can be used, 1 if some can, 2 if none can.",
        ),
    ),
    CommandSpec(
        "correspond", "bring raw scans into dense correspondence; no model is needed",
        ("shapespace correspond scans -o same", "shapespace build same -o model.h5",
         "shapespace correspond new_scans --add -o same"),
        "commands.correspond_changes:correspond",
        (
            basic("scans", "SCAN", "scans of one kind of object: files, folders, patterns, addresses or lists (.csv)",
                  nargs="*"),
            _OUTPUT,
            basic("--template",
                  "FILE", "template mesh, used unchanged (default: the scan closest to all others, meshed "
                  "evenly)", parse=Path),
            basic("--landmarks", "DIR", "landmarks of all or some scans: files with the names of the scans and another "
                  "ending, in any landmark format", parse=Path),
            basic("--vertices", "N", source=CORRESPOND, parse=values.positive),
            advanced("--parts", "NAME", "parts of each specimen, such as femur tibia: NAME_femur.ply and so on, scans "
                     "in folders femur and tibia, or in a list with the columns part and specimen", nargs="+"),
            basic("--add", source=CHANGE_CORRESPONDENCE, either=_CHANGE),
            advanced("--redo", "NAME", source=CHANGE_CORRESPONDENCE, repeat=True, default=[],
                     either=_CHANGE),
            advanced("--remove", "NAME", source=CHANGE_CORRESPONDENCE, repeat=True, default=[],
                     either=_CHANGE),
            advanced("--update", source=CHANGE_CORRESPONDENCE),
            advanced("--model",
                     "MODEL.h5", "shape model of such objects: its mean is the template, and its fit to a scan "
                     "initialises the first round", parse=Path),
            advanced("--subjects", "COLUMN", "column of the list of scans that names the subjects: each scan is then "
                     "registered from the subject's other scans, the most usual one first"),
            advanced("--symmetric-template", source=CORRESPOND),
            advanced("--mirror", source=CORRESPOND),
            advanced("--pose", source=CORRESPOND),
            advanced("--outer", source=CORRESPOND),
            advanced("--groups", help="bring each kind of object into correspondence, in folders group_1 (the largest "
                     "group), group_2, ... of the output folder (default: the largest group only)"),
            advanced("--rounds", "N", source=CORRESPOND, parse=values.positive),
            _RECURSIVE,
            advanced("--strict", help="exclude scans with coordinates that are NaN or infinite (default: remove the "
                     "triangles that use them, with a note)"),
            _jobs_option("scans"),
        ),
        (
            "Writes NAME.corresponding.ply and NAME.correspond.json for each scan, and correspondence.json and "
            "template/mean.ply for the run; landmarks.csv, which build reads, if scans have landmarks. Excluded scans "
            "have a record with the reason, and the exit code is then 1. After Ctrl-C the same command continues the "
            "run.",
        ),
        defaults=_GOES_ON,
        settings=(
            setting("ignore_colours", source=CORRESPOND),
            setting("landmark_uncertainty", "SHARE", source=CORRESPOND, parse=values.share),
            *_EXECUTION_SETTINGS,
            setting("seed", "S", source=CORRESPOND),
        ),
        has_workers=True,
    ),
    CommandSpec(
        "build", "build a shape model from corresponding meshes: Procrustes and PCA",
        ("shapespace build faces/*.ply -o model.h5 --variance 0.98",), "commands.build:build_from_files",
        (
            basic("meshes", "MESH", "mesh files, or folders of them", nargs="+", parse=Path),
            basic("-o --output", "MODEL.h5", "the model", parse=Path, required=True),
            basic("--modes", "K|auto|all", source=BUILD, parse=values.modes, either=_MODES),
            basic("--variance", "SHARE", "as many modes as explain this share of the variance, such as 0.98",
                  parse=values.share, either=_MODES),
            basic("--gauge", source=BUILD_FILES),
            basic("--landmarks", "FILE", source=BUILD_FILES),
            basic("--unit", source=BUILD_FILES, choices=_UNITS),
            basic("--provenance", "TEXT", f"description of the meshes, {_ABOUT_MESHES}", BUILD),
            basic("--licence", "TEXT", f"licence of the meshes, {_ABOUT_MESHES}", BUILD),
            advanced("--recursive", source=BUILD_FILES),
            advanced("--with-doubtful", source=BUILD_FILES),
            advanced("--no-align", help="use the meshes in their pose, without alignment", source=BUILD),
            advanced("--region", "NAME=FILE", "region of the surface, to which fits can be restricted: a CSV "
                     "file of vertices; can be "
                     "repeated", parse=values.named_file, repeat=True),
            advanced("--min-seen", "SHARE", source=BUILD_FILES, parse=values.share),
            advanced("--representation", source=BUILD, choices=_REPRESENTATIONS),
            advanced("--relative-pose", source=BUILD),
            advanced("--control-points", "MxN", source=BUILD, parse=values.control_points),
            advanced("--additive", "LABELS.csv", source=BUILD_FILES, field="labels"),
            advanced("--expression-variance", "SHARE", source=BUILD_FILES, parse=values.share),
            advanced("--out-of-core", source=BUILD,
                     help="stream the meshes through a file next to the model, which is automatic if they would take "
                     "more than four fifths of the free memory; a build that was stopped is continued by the same "
                     "command"),
            advanced("--keep-shapes", source=BUILD_FILES),
            advanced("--add", "OLD.h5", source=BUILD_FILES),
            advanced("--without-training-shapes", source=BUILD),
            advanced("--seed", "S", source=BUILD),
        ),
        (
            "The meshes have the same vertices and triangles. Of a folder that correspond wrote, the surfaces in "
            "correspondence are used; a folder of an unfinished run is rejected. Surfaces whose unit differs from the "
            "majority are converted to the unit of the majority, which --unit sets; with --gauge form or --no-align "
            "they are rejected. With fewer than four meshes, --modes auto keeps all modes. Modes that result from "
            "alignment or rounding alone are always omitted, and counted.",
        ),
    ),
    CommandSpec(
        "quality", "measure a shape model: compactness, generalisation, specificity",
        ("shapespace quality faces -o quality",
         "shapespace quality registered_a registered_b --scans scans -o quality"), "commands.quality:quality",
        (
            basic("targets", "TARGET", "a folder of meshes in correspondence, its meshes, or a model; two are compared",
                  nargs="+", parse=Path),
            _OUTPUT,
            basic("--scans", "FOLDER", source=QUALITY_TARGETS),
            basic("--unseen", "FOLDER", source=QUALITY_TARGETS),
            advanced("--with-doubtful", source=QUALITY_TARGETS),
            basic("--folds", "N|loo", source=QUALITY, parse=values.folds),
            basic("--modes", "K", source=QUALITY, parse=values.positive),
            basic("--samples", "N", source=QUALITY, parse=values.positive),
            advanced("--no-align", help="use the meshes in their pose, without alignment", source=QUALITY),
            advanced("--representation", source=QUALITY_TARGETS, field="representations", nargs="+",
                     choices=(*_REPRESENTATIONS, "articulated"), default=()),
            _jobs_option("folds"),
        ),
        (
            "Writes quality.json, and quality.png and quality.svg, which need the extra report. Of a folder with "
            "fitted surfaces, those of fit --dense are used; of a folder that correspond wrote, its surfaces with "
            "missing vertices. The numbers do not depend on the executor. Fewer than 200,000 vertices in all are "
            "processed by one process.",
        ),
        settings=(
            setting("gauge", source=QUALITY),
            setting("control_points", "MxN", source=QUALITY, parse=values.control_points),
            *_EXECUTION_SETTINGS,
            setting("seed", "S", source=QUALITY),
        ),
    ),
    CommandSpec(
        "info",
        "print facts of a model, a mesh, a fit, a store or a folder of correspond", ("shapespace info model.h5",),
        "commands.look:info",
        (basic("file",
               "FILE|DIR", "a model, a mesh, a record, a store, or a folder that correspond wrote", parse=Path),),
        (
            "Of a folder that correspond wrote: the number of scans in correspondence, excluded and conspicuous scans "
            "with reasons, distances (medians, as shares of the size), missing vertices, folds, movement, CPU time. "
            "Of a store: fits by status, shards, bytes, and damaged files. Of a model: also how many training shapes "
            "the file contains, from which their surfaces can be reconstructed.",
        ),
    ),
    CommandSpec(
        "fit", "fit a model to raw scans: coefficients, pose and fitted surfaces",
        ("shapespace fit model.h5 scan.obj -o out", "shapespace fit model.h5 scans -o out --dense",
         "shapespace build out/*.dense.ply -o new.h5"), "commands.fit:fit",
        (
            basic("model", "MODEL.h5", "the shape model", parse=Path),
            basic("scans", "SCAN", "scans, folders, patterns, addresses such as s3://bucket/x, or lists of these",
                  nargs="+"),
            basic("-o --output", "DIR", "output folder; existing valid results are reused", parse=Path, required=True),
            basic("--landmarks", "FILE|DIR", "landmarks that initialise and constrain the fit, with the names of the "
                  "model's landmarks (at least three): a file for one scan, or a folder with a file for each scan, "
                  "named after it; a list of scans may have a column landmarks instead", parse=Path),
            basic("--unit", source=FIT, choices=("auto", *_UNITS)),
            basic("--region",
                  "NAME|FILE.csv", "restrict the fit, its distances and its status to a region of the model: "
                  "its name, or a CSV file of vertices"),
            basic("--dense", help="also write the fitted surface deformed further onto the scan (NAME.dense.ply)",
                  source=FIT),
            basic("--stages", help="also write the stages of the fit, for figures (NAME.stages.npz)"),
            advanced("--recursive", help="also search subfolders of the given folders"),
            advanced("--method",
                     "NAME", "robust: pose and shape jointly, from distances in both directions; paper: the "
                     "paper's modified ICP", FIT),
            *_FIT_OPTIONS,
            advanced("--no-contact", help="parts of the model, such as bones, must not lie inside each other"),
            _jobs_option("scans"),
            advanced("--again", help="fit all scans again, also those with valid results", either="results"),
            advanced("--store",
                     help="write the results to few files (the default from 10,000 scans on, and in a folder "
                     "with such files); then only counts are reported"),
            advanced("--strict", help=f"{_STRICT_HELP}; exit with 1 when a fit is doubtful", source=FIT),
        ),
        (
            "Writes coefficients.csv, and for each scan NAME.fitted.ply and NAME.fit.json. A bad scan among several "
            "becomes a row with the status failed and its reason. The same command again computes only what is "
            "missing: a result is valid as long as scan, model, landmarks, settings and version are those that it was "
            "computed from, and its files are complete. Surfaces that earlier runs wrote are not used as scans. One "
            "run at a time writes into a folder.",
        ),
        defaults=_GOES_ON,
        settings=(
            _LANDMARK_STDDEV,
            setting("search", source=PAPER, choices=("auto", "vertices", "surface"), default="auto",
                    help="closest points of the paper's method: vertices of the scan (auto), as in the paper, or "
                    "points on its triangles; the robust method always uses the triangles"),
            setting("max_iterations", "N", source=FIT, parse=values.positive),
            *_EXECUTION_SETTINGS,
            setting("seed", "S", source=FIT),
        ),
        has_workers=True,
    ),
    CommandSpec(
        "complete", "complete partial scans: the missing part with its uncertainty, and samples of the complete shape",
        ("shapespace complete model.h5 broken.ply -o completed",
         "shapespace complete model.h5 scans -o completed --mirror combined --stl",
         "shapespace compare completed '~ group' -o compared"), "cli.answers:answer_complete",
        (
            basic("model", "MODEL.h5", "the shape model", parse=Path),
            basic("scans", "SCAN", "scans, folders, patterns, addresses such as s3://bucket/x, or lists of these",
                  nargs="+"),
            _OUTPUT,
            basic("--samples", "N", source=COMPLETION, parse=values.positive),
            basic("--part", "REGION", source=COMPLETION),
            basic("--mirror", source=COMPLETION),
            basic("--landmarks", "FILE|DIR", source=COMPLETION_FILES, parse=Path),
            basic("--unit", source=FIT, choices=("auto", *_UNITS)),
            basic("--stl", source=COMPLETION_FILES),
            advanced("--with-doubtful", source=COMPLETION),
            advanced("--recursive", source=COMPLETION_FILES),
            *_FIT_OPTIONS,
        ),
        (
            "Writes for each scan NAME.ply, the completed surface with the vertices of the model and the property "
            "observed, and NAME.samples.npz, samples of the complete shape in the same frame; completions.csv; "
            "estimates.csv with intervals of volume, area and length; landmarks.csv; methods.txt, and the report. "
            "compare, regress, asymmetry and score read the folder, and use the samples as multiple imputations. A "
            "scan whose fit is doubtful is rejected, as its completion would look more certain than it is. The exit "
            "code is 1 if some scans have no completion, 2 if none has.",
        ),
        settings=(_LANDMARK_STDDEV, setting("seed", "S", source=COMPLETION, parse=values.natural)),
    ),
    CommandSpec(
        "report", "write one HTML report of results: of a folder, or of a study",
        ("shapespace fit model.h5 scans -o out --stages", "shapespace report out",
         "shapespace report corresponding model.h5 groups --specimens table.csv -o study.html"),
        "commands.answers:report",
        (
            basic("results", "RESULT", "a folder that shapespace wrote, such as fits, a correspondence or an analysis; "
                  "several, also models, become the chapters of one report", nargs="+", parse=Path),
            basic("-o --output", "FILE.html", "the report (default: RESULT/report.html)", parse=Path),
            basic("--specimens", "TABLE", "table of the specimens, the first chapter of a report on several results",
                  parse=Path),
            basic("--labels", "FILE", "table of scans and labels (default: labels.csv in RESULT or next to the scans)",
                  parse=Path),
            basic("--no-open", help="do not open the report in a browser"),
            _MODEL_OF_FITS,
        ),
        ("Runs no fit. The report is one file that needs no network. Needs the extra report.",),
    ),
    CommandSpec(
        "view", "view a model, fits, surfaces in correspondence, an analysis or a project in the browser",
        ("shapespace view model.h5",),
        "cli.pages:view",
        (
            basic("path", "MODEL.h5|DIR", "a model, a folder of results, a report, or a project of the studio",
                  parse=Path),
            basic("--model", "MODEL.h5", source=VIEW),
            basic("--no-open", help="do not open a browser"),
            basic("--port", "N", source=VIEW),
            advanced("--host", "H", source=VIEW),
        ),
        (
            "The page is that of the studio, without edits; nothing is written. A project can be shown while the "
            "studio has it open. The address that is printed contains a token, without which nothing is answered. "
            "Ctrl-C ends the viewer. Needs the extra view.",
        ),
        defaults=_FOR_FORMS,
        json=False,
    ),
    CommandSpec(
        "studio", "do the complete work in the browser: scans, correspondence, model, fits, analyses",
        ("shapespace studio teeth",), "cli.pages:studio",
        (
            basic("project", "PROJECT", "folder of the project, created if it is new or empty (default: a page with "
                  "the projects that were opened last)", parse=Path, nargs="?"),
            basic("--no-open", help="do not open a browser"),
            basic("--port", "N", source=STUDIO),
            advanced("--host", "H", source=STUDIO),
            advanced("--max-upload-mb", "N", source=STUDIO, parse=values.positive),
        ),
        (
            "The project's folder contains project.json, the scans (or references to them), and the results, which all "
            "commands can read; history.sh computes them again. The address that is printed contains a token, without "
            "which nothing is answered. Ctrl-C ends the studio; commands that it started continue. Needs the extras "
            "view and report.",
        ),
        json=False,
        defaults=_FOR_FORMS,
    ),
    CommandSpec(
        "landmarks transfer", "transfer landmarks from a few marked specimens to all scans in correspondence",
        ("shapespace correspond scans -o same", "shapespace landmarks transfer marked same -o landmarks"),
        "commands.landmarks:transfer_landmarks",
        (_MARKED, _SAME, _OUTPUT, basic("--semilandmarks", "FILE.csv", source=LANDMARKS_TRANSFER, parse=Path)),
        (
            "Writes the landmarks of each scan, in its frame and unit: NAME.landmarks.csv (position, triangle with "
            "barycentric weights, radius of the 90 % region, status), NAME.landmarks.mrk.json and NAME.landmarks.fcsv, "
            "and landmarks.tps with all scans. Landmarks of marked specimens stay as they are. With --semilandmarks, "
            "curveslide.csv and surfslide.csv contain the numbers of the semilandmarks in landmarks.tps, as geomorph "
            "reads them.",
        ),
    ),
    CommandSpec(
        "landmarks convert", "convert landmarks of many specimens between TPS, NTS, MorphoJ, CSV, R and Slicer files",
        ("shapespace landmarks convert skulls.tps -o skulls.csv",
         "shapespace landmarks convert plethodon.rda -o morphoj.txt"), "commands.landmark_data:convert_landmarks",
        (
            _LANDMARK_DATA,
            basic("-o --output", "OUT", "file; a folder for formats with a file for each specimen", parse=Path,
                  required=True),
            basic("--to", "FORMAT", source=LANDMARKS_CONVERT),
            _SLIDERS,
            basic("--object", "NAME", source=LANDMARKS_CONVERT, field="object_name"),
            basic("--curve-points", "N", source=LANDMARKS_CONVERT, parse=values.positive),
            basic("--dimensions", "D", source=LANDMARKS_CONVERT, parse=values.positive),
        ),
        (
            "Coordinates are exact. Prints the values that were scaled, interpreted as missing or omitted. Sliders are "
            "written next to OUT as geomorph reads them. Files of R need the extra r.",
        ),
    ),
    CommandSpec(
        "landmarks check", "check landmark data, or compare landmarks of marked specimens with their prediction",
        ("shapespace landmarks check skulls.tps", "shapespace landmarks check marked same -o check.csv"),
        "commands.landmark_data:check_landmarks",
        (
            basic("marked", "DATA", "file or folder with the landmarks of many specimens; with SAME, a folder of "
                  "landmark files with the names of the scans", parse=Path),
            basic("scans", "SAME", "folder that correspond wrote", parse=Path, nargs="?"),
            basic("-o --output", "FILE.csv", "with SAME: table of the error of each landmark and specimen",
                  parse=Path),
            _SLIDERS,
        ),
        (
            "Without SAME: numbers of specimens and landmarks, missing landmarks, duplicates, specimens of another "
            "scale, mirrored specimens, swapped landmarks and outliers after superimposition. With SAME, the landmarks "
            "of each marked specimen are compared with their prediction from the others. The exit code is 1 if "
            "something is to be checked.",
        ),
    ),
    CommandSpec(
        "landmarks plot", "draw landmarks of all specimens, superimposed around their mean",
        ("shapespace landmarks plot skulls.tps -o skulls.pdf --links links.csv",),
        "commands.landmark_data:plot_configurations",
        (
            _LANDMARK_DATA,
            basic("-o --output", "FILE", "figure: .svg, .pdf or .png", parse=Path, required=True),
            basic("--links", "FILE.csv", source=LANDMARKS_PLOT, parse=Path),
            _SLIDERS,
        ),
        ("Needs the extra report.",),
    ),
    CommandSpec(
        "landmarks suggest", "name the specimens to mark next",
        ("shapespace landmarks suggest same --marked marked",), "commands.landmarks:suggest_specimens",
        (
            _SAME,
            basic("--marked", "DIR", source=LANDMARKS, parse=Path),
            basic("--count", "N", source=LANDMARKS, parse=values.positive),
        ),
    ),
    CommandSpec(
        "align", "align landmarks by generalised Procrustes analysis, and name specimens to check",
        ("shapespace align skulls.tps --table skulls.csv -o aligned",
         "shapespace compare aligned '~ sex' -o sex"), "cli.answers:answer_align",
        (
            basic("data", "DATA", "a landmark file (TPS, NTS, MorphoJ, CSV, .rda), or a folder of landmark files",
                  parse=Path),
            _OUTPUT,
            basic("--table", "TABLE", source=ALIGN_FILES, parse=Path),
            basic("--sliders", "FILE", "semilandmarks, numbered from 1: rows of before, slide, after for curves, or "
                  "one column for surfaces; can be repeated", source=ALIGN_FILES, parse=Path, repeat=True,
                  default=[]),
            basic("--slide-by", source=ALIGN),
            advanced("--curve-points", "N", source=ALIGN_FILES, parse=values.positive),
            advanced("--dimensions", "D", source=ALIGN_FILES, parse=values.positive),
            basic("--missing", source=ALIGN),
            basic("--separate", "FILE", source=ALIGN_FILES, parse=Path),
            basic("--reflect", "COLUMN=VALUE", "specimens that are reflected before the alignment, such as side=left"),
            basic("--gauge", source=ALIGN),
        ),
        (
            "Writes aligned.csv (name, covariates, centroid size, coordinates), mean.csv, estimated.csv (the estimated "
            "landmarks) and align.json. The commands about cohorts, such as compare, take the folder. Conventions "
            "are those of gpagen in geomorph, but the set is never reflected. Specimens that are outliers, mirrored or "
            "have swapped landmarks are named.",
        ),
        settings=(
            setting("tangent", source=ALIGN),
            setting("match_curves", source=ALIGN),
            setting("tolerance", "T", source=ALIGN),
            setting("iterations", "N", source=ALIGN, parse=values.positive),
        ),
    ),
    CommandSpec(
        "recognise train", "train a classifier on fitted scans with labels",
        ("shapespace recognise train out --labels labels.csv -o expressions.skops",
         "shapespace recognise train out --labels labels.csv -o expressions.skops --relative --classifier "
         "mean-direction"),
        "commands.recognise:recognise_train",
        (
            _RESULTS,
            basic("--labels", "FILE", "table of scans and their labels (column label or expression), with the column "
                  "subject if known; scans of the same name are named by folder and name", parse=Path, required=True),
            basic("-o --output", "FILE.skops", "the classifier", parse=Path, required=True),
            basic("--classifier", "NAME", source=TRAIN),
            basic("--relative", source=TRAIN),
            basic("--neutral", "LABEL", source=TRAIN),
            advanced("--confidence", "P", source=TRAIN, parse=values.probability),
            advanced("--modes", "K", source=TRAIN, parse=values.positive),
            advanced("--expression-of", "MODEL.h5", source=TRAIN),
            advanced("--seed", "S", source=TRAIN),
        ),
        (
            "Failed and doubtful fits and scans without a label are excluded, and counted. The macro accuracy by "
            "cross-validation over subjects is printed. Needs the extra recognise.",
        ),
    ),
    CommandSpec(
        "recognise predict", "classify fitted scans by a trained classifier, as a CSV table",
        ("shapespace recognise predict expressions.skops out -o predictions.csv",),
        "commands.recognise:recognise_predict",
        (
            basic("classifier", "FILE.skops", "the classifier", parse=Path),
            _RESULTS,
            basic("--labels", "FILE", "CSV of file, label and subject: the neutral faces and their subjects, for a "
                  "classifier trained with --relative", parse=Path),
            basic("-o --output", "FILE.csv", "the predictions", parse=Path, required=True),
            basic("--strict", help="exit with 1 when a fit is doubtful or a prediction unsure"),
        ),
        (
            "The table has one row per scan: scan, status, prediction, the probability of each class as p_CLASS, "
            "reason. Fits of another model than the classifier's are rejected. The exit code is 1 if a scan has no "
            "prediction, because its fit failed or its subject has no neutral face, and 2 if no scan has one.",
        ),
    ),
    CommandSpec(
        "recognise transfer", "transfer the expression of one person to another, from fits by an additive model",
        ("shapespace recognise transfer model.h5 out/anna.fit.json out/ben.fit.json -o anna.ply",),
        "commands.recognise:recognise_transfer",
        (
            basic("model", "MODEL.h5", "made by build --additive LABELS.csv", parse=Path),
            basic("person", "PERSON.fit.json", "fit of the person", parse=Path),
            basic("expression", "EXPRESSION.fit.json", "fit of the expression", parse=Path),
            basic("-o --output", "FILE.ply", "the mesh", parse=Path, required=True),
        ),
        ("Both fits must be by that model, with all its modes.",),
    ),
    CommandSpec(
        "recognise study", "measure recognition on unseen subjects, ending in a report",
        ("shapespace recognise study --data BU-3DFE --model model.h5 -o study",), "commands.recognise:recognise_study",
        (
            basic("-o --output", "DIR", "output folder; an interrupted study is continued", parse=Path,
                  default=Path("shapespace-study")),
            basic("--data", "DIR", "labelled scans: BU-3DFE, Bosphorus, or a folder with labels.csv", parse=Path),
            basic("--model", "MODEL.h5", "shape model that is fitted to them", parse=Path),
            basic("--folds", "N", "folds of subjects, fewer for fewer subjects", STUDY, default=10,
                  parse=values.positive),
            _jobs_option("fits"),
            _NO_OPEN,
        ),
        (
            "The study on simulated people is a script of the source, studies/recognition.py. Needs the extras report "
            "and recognise.",
        ),
        defaults=_GOES_ON,
        settings=(*_EXECUTION_SETTINGS, setting("seed", "S", source=STUDY)),
    ),
    CommandSpec(
        "recognise verify", "test whether two scans are of one subject: error rates, likelihood ratios",
        ("shapespace recognise verify scans.csv -o verified --gallery session=1",), "cli.answers:answer_verify",
        (
            *_IDENTITY_OPTIONS,
            advanced("--curve", "K,K,...", source=IDENTITY, parse=values.mode_counts),
            advanced("--by", "COLUMN", source=IDENTITY),
        ),
        (
            "Computes ROC and DET curves, the equal error rate, the rates of true accepts at given false accepts with "
            "intervals over subjects, and calibrated likelihood ratios.", _IDENTITY_RULES,
        ),
        settings=_IDENTITY_SETTINGS,
    ),
    CommandSpec(
        "recognise identify", "identify the subject of a scan among the enrolled ones: ranks and error rates",
        ("shapespace recognise identify scans.csv -o identified --gallery expression=neutral",),
        "cli.answers:answer_identify",
        _IDENTITY_OPTIONS,
        (
            "Computes ranks (CMC), and the rate of misses if subjects who are not enrolled are searched for too.",
            _IDENTITY_RULES,
        ),
        settings=_IDENTITY_SETTINGS,
    ),
    CommandSpec(
        "cohort", "write a cohort file: shapes, table and settings, which all questions about shapes read",
        ("shapespace cohort people.csv --shapes same --gauge form -o bones.toml",
         "shapespace compare bones.toml '~ sex' -o sex"), "cli.answers:answer_cohort",
        (
            replace(_DATA, help=_DATA.help.replace("a cohort file (.toml); ", "")),
            basic("-o --output", "FILE.toml", "the cohort file", parse=Path, required=True),
            _SHAPES,
            *(replace(option, names=f"--{option.names}", setting=False, basic=option.names in _BASIC_OF_COHORT)
              for option in COHORT_SETTINGS),
        ),
        (
            "The shapes are read once, so that unusable data are reported at once. Paths in the file are relative to "
            "it. A question takes the file in place of a table, and --set changes one of its settings for one answer.",
        ),
    ),
    CommandSpec(
        "figures", "draw the figures of results as files for a paper",
        ("shapespace figures sex --format svg,pdf", "shapespace figures sex --format png --dpi 600 --views dorsal"),
        "cli.answers:result_figures",
        (
            basic("folder", "OUT", "written by compare or another question, fit, correspond, recognise study or demo",
                  parse=Path),
            basic("--format", "LIST", source=FIGURES, field="formats"),
            basic("--dpi", "N", source=FIGURES, parse=values.positive),
            basic("--views", "LIST", source=FIGURES),
            basic("--orientation", "FILE", source=FIGURES),
            _MODEL_OF_FITS,
        ),
        ("Writes OUT/figures with captions.txt. Needs the extra report.",),
    ),
    CommandSpec(
        "compare", "test effects of groups and covariates on shape by linear models",
        ("shapespace compare people.csv '~ sex + age' -o sex-and-age",), "cli.answers:answer_compare",
        (
            *_COHORT,
            basic("formula", "FORMULA", "linear model of shape, such as '~ sex + age'; size and log_size are available "
                  "too"),
            basic("--blocks", "COLUMN", source=COMPARE),
            basic("--permutations", "N", source=COMPARE, parse=values.integer),
            advanced("--random", "TERMS", source=COMPARE),
            advanced("--error", "TERM=ERROR", "error term of a term, over whose mean square its F is computed, such as "
                     "genus=genus:species; can be repeated (default: the residuals)", parse=values.error_term,
                     repeat=True),
            advanced("--type", source=COMPARE, field="anova_type", dest="anova_type"),
            advanced("--level", "P", source=COMPARE, field="alpha"),
            advanced("--variances", source=COMPARE),
            advanced("--bumps", "MM", source=COMPARE, field="bump_width_mm"),
            advanced("--pose-axes", "A,B,C", source=COMPARE),
        ),
        settings=_question_settings(
            setting("error_permutation", source=COMPARE),
            setting("coding", source=COMPARE),
            setting("effect_size", source=COMPARE),
            setting("weights", source=COMPARE),
            setting("maps", source=COMPARE),
            setting("seed", "S", source=COMPARE, parse=values.integer),
        ),
    ),
    CommandSpec(
        "morphospace", "draw shapes on axes of an ordination, and the shape at any place: PCA, CVA, phylogenetic axes",
        ("shapespace morphospace people.csv --group sex -o morphospace",
         "shapespace morphospace species.tps --tree species.nwk -o phylomorphospace"), "cli.answers:answer_morphospace",
        (
            *_COHORT,
            basic("--method", source=MORPHOSPACE),
            basic("--group", "COLUMN", source=MORPHOSPACE),
            basic("--tree", "FILE", source=MORPHOSPACE),
            basic("--axes", "A,B", "numbers of the axes drawn across and up", parse=values.axes, default=(1, 2)),
            advanced("--components", "N", source=MORPHOSPACE, parse=values.positive),
        ),
        (
            "In the plot of the report a click, or the arrow keys, choose a place; the shape there is drawn next to "
            "the mean. Scores, loadings (change of each coordinate per unit of score) and eigenvalues are CSV tables.",
        ),
        settings=_question_settings(),
    ),
    *(_shape_test(test) for test in SHAPE_TESTS),
    CommandSpec(
        "change", "measure change between visits of the same subjects, in mm, and its noise",
        ("shapespace change visits.csv -o change --order before,after",), "cli.answers:answer_change",
        (
            *_COHORT,
            basic("--time", "COLUMN", source=CHANGE),
            basic("--order", "LIST", source=CHANGE),
            basic("--group", "COLUMN", source=CHANGE),
            basic("--stable", "WHAT", source=CHANGE),
            advanced("--region", "NAME=FILE", "region whose volume is also reported: a CSV file of vertices; can be "
                     "repeated (default: the regions of the model)", parse=values.named_file, repeat=True),
            advanced("--variances", source=CHANGE),
            advanced("--rate", source=CHANGE),
            advanced("--permutations", "N", source=CHANGE, parse=values.integer),
        ),
        settings=_question_settings(
            setting("seed", "S", source=CHANGE, parse=values.integer), without=("gauge", "unit")
        ),
    ),
    CommandSpec(
        "asymmetry", "measure asymmetry: scores and maps, directional and fluctuating asymmetry",
        ("shapespace asymmetry skulls.csv -o asymmetry --set surfaces=dense",), "cli.answers:answer_asymmetry",
        (
            *_COHORT,
            basic("--reference", "COLUMN=VALUE", "group that scores are compared with (default: all)"),
            basic("--pairs",
                  "PAIRS.csv", "two columns of landmarks that mirror each other, by name or by number from 1; those in "
                  "no pair lie on the plane of symmetry; of surfaces: names of landmarks, or vertices from 0, those on "
                  "the plane paired with themselves, others excluded (default: found on the mean)",
                  parse=Path),
            basic("--side", "COLUMN", source=ASYMMETRY),
            advanced("--degrees-of-freedom", source=ASYMMETRY),
            advanced("--permutations", "P", source=ASYMMETRY, parse=values.integer),
        ),
        settings=_question_settings(setting("seed", "S", source=ASYMMETRY, parse=values.integer)),
    ),
    CommandSpec(
        "regress", "predict a number, such as age, from shape, or the mean shape along a number, with intervals",
        ("shapespace regress people.csv --target age -o age --predict new.csv",
         "shapespace regress people.csv --along age --at 20,40,60 --covariates sex -o growth"),
        "cli.answers:answer_regress",
        (
            *_COHORT,
            basic("--target", "COLUMN", source=REGRESS, either=_TARGET, required=True),
            basic("--predictor", "FILE.npz", "predict DATA with the predictor.npz of an earlier run", parse=Path,
                  either=_TARGET, required=True),
            basic("--along", "COLUMN", source=ALONG, either=_TARGET, required=True),
            basic("--at", "VALUES", source=ALONG, parse=values.numbers),
            advanced("--covariates", "TERMS", source=ALONG),
            advanced("--length", "A,B", "with --along: two landmarks whose distance is predicted too; can be repeated",
                     source=ALONG, field="lengths", parse=values.words, repeat=True, default=[]),
            basic("--predict", "NEW", "also predict new shapes, of other subjects: a table, a folder or a cohort file",
                  parse=Path),
            advanced("--permutations", "P", "permutations for p, 0 for none (default: 199, or 1000 with --along)",
                     parse=values.integer),
        ),
        settings=_question_settings(
            setting("curve", source=ALONG, default=None),
            setting("hold", "COLUMN=VALUE", "with --along: value of another column, such as sex=female; separate "
                    "several by commas (default: numbers at their mean, and classes count alike)", parse=values.words),
            setting("folds", "K", source=REGRESS, parse=values.integer),
            setting("level", "L", "coverage of intervals (default: 0.9, or 0.95 with --along)", dest="confidence",
                    parse=values.number),
            setting("seed", "S", source=REGRESS, parse=values.integer),
        ),
    ),
    CommandSpec(
        "score", "score new subjects against a reference population: distance, percentile, z-map",
        ("shapespace score patients -o scored --reference controls.csv",), "cli.answers:answer_score",
        (
            *_COHORT,
            basic("--reference", "DATA", "the population: a table, a cohort file, fits or landmarks; its doubtful fits "
                  "are excluded", parse=Path, required=True),
            basic("--modes", "N", source=SCORE, parse=values.integer),
            basic("--nearest", "N", source=SCORE, parse=values.integer),
        ),
        settings=_question_settings(setting("seed", "S", source=SCORE, parse=values.integer)),
    ),
    CommandSpec(
        "export", "export fits as single files or one table, or any cohort to geomorph, MorphoJ, TPS or CSV",
        ("shapespace export out anna ben -o single", "shapespace export out --table fits.csv",
         "shapespace export aligned --to geomorph --formula '~ sex' -o r"), "cli.answers:answer_export",
        (
            basic("store", "DATA", "a folder that shapespace fit wrote; with --to, any data of compare", parse=Path),
            basic("names", "NAME", "names of the fits", nargs="*"),
            basic("-o --output", "OUT", "output folder; with --to also a file", parse=Path, default=Path("exported")),
            basic("--all", help="export all fits"),
            basic("--table", "FILE", source=EXPORT),
            basic("--to", source=EXPORT_COHORT),
            basic("--formula", "FORMULA", source=EXPORT_COHORT),
            _SHAPES,
        ),
        (
            "With --to, the aligned coordinates, the table and the sizes of a cohort are written. For geomorph, "
            "shapespace.R reads them and tests the formula with procD.lm; without geomorph it computes the sums of "
            "squares alone, in anova.csv.",
            "NAME.fit.json is that of fit to the byte, surfaces are exact to 6e-8 of their half extent. The table has "
            "the columns of coefficients.csv, the rows of each shard in turn; in MATLAB it is a struct fits with b, "
            "z, b_stddev, scan and so on. The exit code is 1 if some of the fits cannot be read, 2 if none can.",
        ),
        settings=_question_settings(),
    ),
    CommandSpec(
        "convert", "convert a shape model from or to the format of another tool",
        ("shapespace convert femur.h5.json femur.h5", "shapespace convert model.h5 model.bin --to eos"),
        "commands.convert:convert",
        (
            basic("source", "IN", "a model in any format that can be read", parse=Path),
            basic("output", "OUT", "its extension sets the format; .h5 is the format of shapespace", parse=Path),
            basic("--to", "FORMAT", source=CONVERT),
            basic("--unit", "UNIT", "unit of the model, if its format does not contain it (default: mm)",
                  choices=_UNITS),
            advanced("--expressions", "FILE.bin", source=CONVERT),
            advanced("--parts", "NAME", source=CONVERT, nargs="+"),
        ),
        ("Prints the parts that were kept, changed and omitted. Training shapes are always omitted.",),
    ),
    CommandSpec(
        "cache", "print the folder and size of the cache, or clear it", ("shapespace cache --clear",),
        "commands.cache:cache",
        (basic("--clear", help="remove all entries; fits compute them again"),),
        (
            "The cache contains residual modes of the models that were fitted. SHAPESPACE_CACHE sets another folder; "
            "SHAPESPACE_KEEP=no turns the cache off.",
        ),
    ),
)  # fmt: skip


def summaries_and_options() -> dict[str, tuple[str, tuple[Option, ...]]]:
    """Return name -> summary, and options and settings of all commands."""
    return {command.name: (command.summary, (*command.options, *command.settings)) for command in COMMANDS}
