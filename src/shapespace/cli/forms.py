"""Forms of the commands for the studio, made from the table of commands."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from shapespace.cli.answers import reason_of_rejection
from shapespace.cli.options import Option
from shapespace.formats.registry import MODEL_FORMATS
from shapespace.statistics.shape_tests.test_table import SHAPE_TESTS

_KINDS: Mapping[str, str] = {
    "identify": "recognise identify",
    **{test.name: f"test {test.name}" for test in SHAPE_TESTS},
}
_FIRST: Mapping[str, tuple[str, ...]] = {
    "correspond": ("--vertices", "--mirror", "--pose"),
    "figures": ("--format",),
    "build": ("--modes", "--gauge", "--unit"),
    "quality": ("--folds", "--samples", "--modes"),
    "morphospace": ("--method", "--group", "--gauge"),
    "fit": ("--dense", "--unit", "--stages"),
    "complete": ("--samples", "--mirror", "--stl"),
    "compare": ("--formula", "--blocks", "--permutations"),
    "change": ("--subject", "--time", "--order"),
    "asymmetry": ("--subject", "--reference", "--gauge"),
    "regress": ("--target", "--along", "--at", "--curve", "--covariates", "--subject"),
    "score": ("--reference", "--subject", "--nearest"),
    "identify": ("--subject", "--gallery", "--probe"),
    "convert": ("--to",),
    "export": (),
    "report": (),
    **{
        test.name: (
            *(f"--{name}" for name in test.required),
            *(f"--{name}" for name, value in test.options.items() if value != "FORMULA" and name not in test.required),
        )
        for test in SHAPE_TESTS
    },
}
"""Command -> the options that its form shows; the others are folded."""
_FILES = frozenset(
    f"--{name}"
    for name in (
        "output", "shapes", "model", "table", "labels", "template", "subjects", "add", "redo", "remove", "update",
        "recursive", "dask", "executor", "predictor", "predict", "no-open", "json", "quiet", "all", "groups",
        "specimens", "surfaces", "set", "orientation",
    )
)  # fmt: skip
"""Options that the studio sets itself, or that name files."""


_ACTIONS: Mapping[str, str] = {
    "correspond": "Correspondence", "build": "Build the model", "quality": "Measure the quality",
    "morphospace": "Draw the morphospace", "figures": "Draw figures for print", "fit": "Fit the model",
    "complete": "Complete partial scans", "compare": "Do groups differ?", "change": "Has it changed?",
    "asymmetry": "Is it symmetric?", "regress": "Shape and a number?", "score": "How unusual is it?",
    "identify": "Who is it?", "report": "Report", "convert": "Convert the model", "export": "Export",
    "disparity": "Which group varies more?", "equality": "Do groups differ in mean or variation?",
    "equivalence": "Are groups practically the same?", "power": "How many specimens are needed?",
    "discriminant": "Can groups be distinguished?", "pairwise": "Which pairs of groups differ?",
    "trajectory": "Do groups change in the same way?", "allometry": "Does shape depend on size?",
    "repeatability": "How repeatable is the measurement?", "pls": "Does shape vary with several measurements?",
    "integration": "Do parts vary together?", "modularity": "Are parts independent modules?",
    "signal": "Are related species similar?", "pgls": "Does shape vary with a trait along a phylogeny?",
}  # fmt: skip
"""Command -> its name in the studio."""
_QUESTIONS = frozenset(
    {"compare", "change", "asymmetry", "regress", "score", "identify", *(t.name for t in SHAPE_TESTS)}
)
_LABELS: Mapping[str, str] = {
    "anova-type": "Sums of squares", "columns": "Columns of measurements", "covariate": "Covariate", "effect": "Effect",
    "margin": "Margin (distance)", "margin-sd": "Margin (standard deviations)", "modules": "File of modules",
    "null": "Reduced model", "partial": "Partial disparity", "points": "Points of the trajectory",
    "priors": "Prior probabilities", "residuals": "Residuals to permute", "separate": "Slope of each group",
    "session": "Session", "simulations": "Simulations", "sizes": "Sample sizes",
    "additive": "Separate identity and expression", "again": "Fit all scans again", "along": "Predict shapes along",
    "at": "Values of the number", "axes": "Axes of the plot", "blocks": "Subjects with several scans",
    "bumps": "Width of local changes (mm)", "coding": "Coding of classes", "components": "Principal components",
    "control-points": "Control points", "covariates": "Covariates", "crop": "Crop", "curve": "Kind of dependence",
    "degrees-of-freedom": "Degrees of freedom", "dense": "Dense surfaces", "doubtful": "Include doubtful shapes",
    "dpi": "Resolution (dpi)", "draws": "Bootstrap samples", "effect-size": "Effect size Z", "error": "Error terms",
    "error-permutation": "Permutation with error terms", "expression-variance": "Explained variance of expressions",
    "expressions": "File of blendshapes", "folds": "Folds of the cross-validation", "format": "File formats",
    "formula": "Formula", "gallery": "Scans to enrol", "gauge": "Size handling", "geometry": "Surface or landmarks",
    "group": "Groups", "hold": "Class of another column", "ignore-colours": "Ignore colours",
    "imputations": "Samples of completed shapes", "jobs": "Parallel computations", "keep-shapes": "Keep aligned shapes",
    "landmark-stddev-mm": "Standard deviation of landmarks (mm)", "landmarks": "Landmarks",
    "landmark-uncertainty": "Standard deviation of landmarks (share of size)", "length": "Predicted length",
    "level": "Significance level", "licence": "Licence", "maps": "Test each vertex",
    "max-iterations": "Maximum iterations", "method": "Method", "min-seen": "Minimum observed share",
    "mirror": "Mirror images", "missing": "Missing values", "modes": "Number of modes", "nearest": "Nearest subjects",
    "no-align": "Without alignment", "order": "Order of times", "out-of-core": "Stream through a file",
    "outer": "Remove inner surfaces", "pairs": "Mirrored pairs", "part": "Region to estimate",
    "permutations": "Permutations", "pose": "Rotation of the scans", "probe": "Scans to identify",
    "provenance": "Origin of the meshes", "random": "Random effects", "rate": "Change per unit of time",
    "reference": "Reference group", "region": "Region", "representation": "Surface representation",
    "role": "Role of the scans", "rounds": "Rounds", "samples": "Number of samples", "scale": "Scale",
    "scans": "Folder of scans", "scores": "Scores", "search": "Closest points", "seed": "Random seed",
    "side": "Left or right", "stable": "Unchanged part", "stages": "Stages for figures", "stl": "STL files for CAD",
    "store": "Few result files", "strict": "Reject invalid coordinates", "subject": "Subject",
    "symmetric-template": "Symmetric template", "target": "Number to predict", "time": "Time",
    "timeout": "Time limit (s)", "to": "Format", "train": "Training scans", "tree": "Phylogeny",
    "type": "Type of sums of squares", "uncertainty": "Use errors of the fits", "unit": "Unit",
    "unseen": "Folder of unseen shapes", "variance": "Explained variance", "variances": "Variances of classes",
    "vertices": "Vertices", "views": "Views", "weights": "Weights of vertices",
    "with-doubtful": "Include doubtful results", "without-training-shapes": "Omit training shapes",
    "regress --level": "Coverage of intervals",
}  # fmt: skip
"""Option, without dashes and if need be after its command -> its label in the studio."""


def forms(commands: Mapping[str, tuple[str, Sequence[Option]]]) -> dict[str, dict[str, Any]]:
    """Return kind -> the words, label and summary of its command, the options of its form, and of a question the
    function that checks its input.

    Args:
        commands: name -> summary and options, of all commands.
    """
    made: dict[str, dict[str, Any]] = {}
    for kind, first in _FIRST.items():
        command = _KINDS.get(kind, kind)
        made[kind] = {
            "command": tuple(command.split()), "label": _ACTIONS[kind], "is_question": kind in _QUESTIONS,
            **_make_form(kind, *commands[command], first), "check": reason_of_rejection
        }  # fmt: skip
    made["convert"]["options"][0] |= {"kind": "choice", "choices": list(MODEL_FORMATS)}
    made["score"]["options"][0] |= {"kind": "class", "help": "class that the others are compared with"}
    hold = next(option for option in made["regress"]["options"] if option["label"] == _LABELS["hold"])
    hold["help"] = "with --along: class of another column for which shapes are predicted"
    return made


def _make_form(kind: str, summary: str, options: Sequence[Option], first: tuple[str, ...]) -> dict[str, Any]:
    order = {flag: place for place, flag in enumerate(first)}
    offered = [
        option for option in options
        if (not option.is_positional or option.metavar == "FORMULA") and _page_name(option) not in _FILES
    ]  # fmt: skip
    described = [_describe_option(kind, option, visible=_page_name(option) in order) for option in offered]
    described.sort(key=lambda one: order.get(one["flag"], len(order)))
    return {"summary": summary, "options": described}


def _page_name(option: Option) -> str:
    """Return the name of an option on the page, also of a setting and of a formula."""
    return f"--{option.names.replace('_', '-')}" if option.setting or option.is_positional else option.spellings[-1]


def _describe_option(kind: str, option: Option, *, visible: bool) -> dict[str, Any]:
    choices = list(option.accepted) or (["yes", "no"] if option.value_name == "yes|no" else [])
    flag = _page_name(option)
    argument = f"--set {option.names}" if option.setting else "" if option.is_positional else option.spellings[-1]
    return {
        "flag": flag, "argument": argument, "label": _LABELS.get(f"{kind} {flag}", _LABELS[flag[2:]]),
        "help": option.text.replace("`", ""), "kind": "choice" if choices else _kind(option),
        "choices": choices, "initial": option.initial_text or None, "visible": visible,
        "required": (option.required and not option.either) or option.names in ("formula", "--to"),
    }  # fmt: skip


def _kind(option: Option) -> str:
    named = {"FORMULA": "formula", "COLUMN": "column", "COLUMN=VALUE": "class", **dict.fromkeys("NKSM", "number")}
    return "flag" if option.is_flag else named.get(option.metavar, "text")
