"""Forms of the commands for the studio, made from the table of commands."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from shapespace.cli.answers import reason_of_rejection
from shapespace.cli.options import Option
from shapespace.formats.registry import MODEL_FORMATS
from shapespace.io.landmarks.configuration_io import CONFIGURATION_FORMATS, FOLDER_FORMATS
from shapespace.statistics.shape_tests.test_table import SHAPE_TESTS

_KINDS: Mapping[str, str] = {
    "identify": "recognise identify",
    "landmarks": "landmarks convert",
    "groom": "check",
    **{test.name: f"test {test.name}" for test in SHAPE_TESTS},
}
_FIRST: Mapping[str, tuple[str, ...]] = {
    "surface": ("--label", "--smooth"),
    "groom": ("--crop", "--outer", "--largest", "--fill-holes"),
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
    "landmarks": ("--to",),
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
        "specimens", "surfaces", "set", "orientation", "sliders", "object", "curve-points", "dimensions",
    )
)  # fmt: skip
"""Options that the studio sets itself, or that name files."""


_ACTIONS: Mapping[str, str] = {
    "surface": "Surfaces of label volumes", "groom": "Groom scans",
    "correspond": "Correspondence", "build": "Build the model", "quality": "Measure the quality",
    "morphospace": "Draw the morphospace", "figures": "Draw figures for print", "fit": "Fit the model",
    "complete": "Complete partial scans", "compare": "Do groups differ?", "change": "Has it changed?",
    "asymmetry": "Is it symmetric?", "regress": "Shape and a number?", "score": "How unusual is it?",
    "identify": "Who is it?", "report": "Report", "convert": "Convert the model", "export": "Export",
    "landmarks": "Export landmarks",
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
    "keep-pieces": "Keep all pieces and cavities", "label": "Labels", "largest": "Keep the largest piece",
    "fill-holes": "Fill holes with border edges up to", "smooth": "Smoothing (voxels)",
    "max-memory": "Memory limit", "symmetric": "Symmetric mesh",
    "landmark-stddev-mm": "Standard deviation of landmarks (mm)", "landmarks": "Landmarks",
    "landmark-uncertainty": "Standard deviation of landmarks (share of size)", "length": "Predicted length",
    "level": "Significance level", "licence": "Licence", "maps": "Test each vertex",
    "max-iterations": "Maximum iterations", "method": "Method", "min-seen": "Minimum observed share",
    "mirror": "Mirror images", "missing": "Missing values", "modes": "Number of modes", "nearest": "Nearest subjects",
    "no-contact": "Parts without penetration",
    "no-align": "Without alignment", "order": "Order of times", "out-of-core": "Stream through a file",
    "outer": "Remove inner surfaces", "pairs": "Mirrored pairs", "part": "Region to estimate",
    "permutations": "Permutations", "pose": "Rotation of the scans", "probe": "Scans to identify",
    "provenance": "Origin of the meshes", "random": "Random effects", "rate": "Change per unit of time",
    "reference": "Reference group", "region": "Region", "parts": "Parts of each specimen",
    "pose-axes": "Axes of relative poses",
    "relative-pose": "Relative pose of the parts",
    "representation": "Surface representation",
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
_HELPS: Mapping[str, str] = {
    "build --additive": "path of a table in the project's folder with the columns file, subject and label, such as "
    "labels.csv, with a neutral face of each subject; the number of modes then counts modes of identity",
    "regress --at": "values of the number within the observed range, with commas, such as 25,30,40 (default: five "
    "from the 5th to the 95th percentile)",
    "morphospace --axes": "numbers of the axes drawn across and up, with a comma, such as 1,2",
    "compare --bumps": "for fits: width (standard deviation, mm) of a bump along the normals that is also searched "
    "for at each vertex, such as 5 (default: no search)",
    "pls --columns": "columns of numbers, with commas, such as length,width; they are compared with shape",
    "regress --covariates": "further columns of the linear model, such as sex + site; sex + age:sex adds their "
    "interaction",
    "crop": "part of the scan that is fitted, in its frame and unit: a sphere by its centre and radius, such as "
    "sphere:0,20,0,60; a box by two corners, such as box:-50,-50,0,50,50,90; or all within a distance in mm of the "
    "landmarks, such as landmarks:40",
    "compare --error": "error term over whose mean square the F of a term is computed: the term and its error term, "
    "such as genus=genus:species (default: the residuals)",
    "convert --expressions": "path of the file of blendshapes of eos in the project's folder, such as blendshapes.bin",
    "figures --format": "formats of the figures, with commas, such as svg,pdf,png",
    "identify --gallery": "scans to enrol, by the classes of a column, such as expression=neutral or session=1,2; "
    "session!=1,2 enrols all others (default: the first scan of each subject)",
    "identify --probe": "scans to compare with the enrolled ones, by the classes of a column, such as "
    "expression=smile (default: all that are neither enrolled nor used for training)",
    "identify --train": "training scans, by the classes of a column, such as site=north (default: the scans of the "
    "subjects in the other folds)",
    "landmarks": "path of a table in the project's folder with the columns name and vertex, such as landmarks.csv "
    "(default: the landmarks of the model or the correspondence)",
    "correspond --landmarks": "path of a folder with a file of landmarks for each scan, named after it, such as marks",
    "fit --landmarks": "path of a folder with a file of landmarks for each scan, named after it, such as marks; they "
    "have the names of the model's landmarks (at least three)",
    "complete --landmarks": "path of a folder with a file of landmarks for each scan, named after it, such as marks",
    "regress --length": "for shapes along a number: two landmarks with a comma, such as nasion,gnathion, whose "
    "distance is predicted too",
    "build --licence": "licence of the meshes, kept in the model file, such as CC BY 4.0",
    "equivalence --margin": "smallest Procrustes distance, in the unit of the data, of means that are not equivalent, "
    "such as 0.02",
    "equivalence --margin-sd": "margin in standard deviations within groups, the root of the pooled Procrustes "
    "variance, such as 0.5",
    "modules": "path of a table in the project's folder with the columns landmark (or vertex, from 0) and module, "
    "such as modules.csv",
    "change --order": "order of times that are words, the earliest first, with commas, such as before,after",
    "trajectory --order": "classes of the points in their order, with commas, such as larva,juvenile,adult (default: "
    "numbers ascending, others alphabetically)",
    "asymmetry --pairs": "path of a table in the project's folder with two columns of landmarks that mirror each "
    "other, such as pairs.csv: by name, or by number from 1; of surfaces also vertices from 0, those on the plane "
    "paired with themselves (default: found on the mean)",
    "complete --part": "region of the model that is estimated even where the scan shows it, such as jaw (default: "
    "none)",
    "build --provenance": "description of the meshes, kept in the model file, such as 40 skulls, micro-CT",
    "region": "region of the surface: its name, and the path of a table of its vertices in the project's folder, such "
    "as jaw=jaw.csv",
    "fit --region": "region to which the fit, its distances and its status are restricted: its name in the model, "
    "such as jaw, or the path of a table of vertices",
    "quality --scans": "path of the folder of the scans that the surfaces were made from, with the same names, pose "
    "and unit, such as scans; distances are measured to these",
    "identify --scores": "scores, with commas, such as plda,cosine; the choices are plda, cosine, mahalanobis and "
    "distance, and the summary reports the first (default: all)",
    "power --sizes": "numbers of shapes in each group, with commas, such as 10,20,40",
    "change --stable": "part that did not change, by which visits are aligned: auto (found), all, a region of the "
    "model, the path of a table of vertices, such as skull.csv, or all within a distance in mm of landmarks, such as "
    "landmarks:nasion,sella,20",
    "tree": "path of a Newick or Nexus file in the project's folder, such as tree.nwk, whose tips have the names of "
    "the specimens",
    "quality --unseen": "path of a folder of corresponding shapes that no model was trained on, such as unseen; the "
    "error on these is measured too",
    "figures --views": "names of the views to draw, with commas, such as dorsal,lateral (default: all views)",
    "score --reference": "class that the others are compared with",
    "hold": "for shapes along a number: class of another column for which they are predicted",
}
"""Option, named as for its label -> help of an option whose help on the command line is about files or the terminal."""


def forms(commands: Mapping[str, tuple[str, Sequence[Option]]]) -> dict[str, dict[str, Any]]:
    """Return kind -> the words, label and summary of its command, the options of its form, and of a question the
    function that checks its input.

    Args:
        commands: name -> summary and options, of all commands.
    """
    from shapespace.viewer.studio.placed_landmarks import MISSING_CHOICES, MISSING_LANDMARKS  # slow to import

    made: dict[str, dict[str, Any]] = {}
    for kind, first in _FIRST.items():
        command = _KINDS.get(kind, kind)
        made[kind] = {
            "command": tuple(command.split()), "label": _ACTIONS[kind], "is_question": kind in _QUESTIONS,
            **_make_form(kind, *commands[command], first), "check": reason_of_rejection
        }  # fmt: skip
    # Other options of this command change the unit or the side, which are set for each specimen.
    made["groom"]["options"] = [option for option in made["groom"]["options"] if option["visible"]]
    made["convert"]["options"][0] |= {"kind": "choice", "choices": list(MODEL_FORMATS)}
    made["landmarks"]["options"][0] |= {
        "kind": "choice", "choices": [*CONFIGURATION_FORMATS, *FOLDER_FORMATS], "initial": "csv",
        "help": "csv has a row for each specimen, long a row for each landmark; the last two are of 3D Slicer",
    }  # fmt: skip
    made["score"]["options"][0]["kind"] = "class"
    # Changes in mm and identities need surfaces or fits.
    for kind in _QUESTIONS.union(("morphospace",)) - {"identify", "change"}:
        made[kind]["options"].append({
            "flag": MISSING_LANDMARKS, "argument": "", "label": "Missing landmarks", "kind": "choice",
            "help": "specimens that lack landmarks, or landmarks that specimens lack, are excluded, or missing "
            "landmarks are estimated; the estimate is from the complete specimens, by a thin-plate spline of their "
            "mean or by regression",
            "choices": list(MISSING_CHOICES), "initial": MISSING_CHOICES[0], "visible": True, "required": False,
        })  # fmt: skip
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
    plain = _HELPS.get(f"{kind} {flag}") or _HELPS.get(flag[2:])
    return {
        "flag": flag, "argument": argument, "label": _LABELS.get(f"{kind} {flag}", _LABELS[flag[2:]]),
        "help": plain or option.text.replace("`", ""), "kind": "choice" if choices else _kind(option),
        "choices": choices, "initial": option.initial_text or None, "visible": visible,
        "required": (option.required and not option.either) or option.names in ("formula", "--to"),
    }  # fmt: skip


def _kind(option: Option) -> str:
    named = {"FORMULA": "formula", "COLUMN": "column", "COLUMN=VALUE": "class", **dict.fromkeys("NKSM", "number")}
    return "flag" if option.is_flag else named.get(option.metavar, "text")
