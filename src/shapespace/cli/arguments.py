"""What may be written on the command line."""

from __future__ import annotations

import argparse
import re
from pathlib import Path
from typing import Any, cast

from shapespace.cli import run
from shapespace.cli.answers import asymmetry, change, compare, identity, regress, score
from shapespace.version import __version__

_EXECUTORS = ("local", "serial", "dask")
_UNITS = ("auto", "um", "mm", "cm", "inch", "m")


def parser() -> argparse.ArgumentParser:
    """Return the parser of all commands."""
    top = argparse.ArgumentParser(
        prog="shapespace",
        description="Statistical shape models from raw 3-D scans: correspondence, model building, robust fitting and "
        "shape statistics.",
    )
    top.add_argument("--version", action="version", version=f"shapespace {__version__}")
    commands = top.add_subparsers(required=True, metavar="COMMAND")
    _add_demo(commands)
    _add_data(commands)
    _add_surface(commands)
    _add_check(commands)
    _add_correspond(commands)
    _add_build(commands)
    _add_quality(commands)
    _add_info(commands)
    _add_fit(commands)
    _add_report(commands)
    _add_view(commands)
    _add_recognise(commands)
    compare.add(
        _add(commands, "compare", "test effects of groups and covariates on shape by linear models",
             "shapespace compare people.csv --formula '~ sex + age' -o sex-and-age")
    )  # fmt: skip
    change.add(
        _add(commands, "change", "measure change between visits of the same subjects, in mm, and its noise",
             "shapespace change visits.csv -o change --order before,after")
    )  # fmt: skip
    asymmetry.add(
        _add(commands, "asymmetry", "measure asymmetry: scores and maps, directional and fluctuating asymmetry",
             "shapespace asymmetry skulls.csv --surfaces dense -o asymmetry")
    )  # fmt: skip
    regress.add(
        _add(commands, "regress", "predict a number, such as age, from shape, with its cross-validated accuracy",
             "shapespace regress people.csv --target age -o age --predict new.csv")
    )  # fmt: skip
    score.add(
        _add(commands, "score", "score new subjects against a reference population: distance, percentile, z-map",
             "shapespace score patients -o scored --reference controls.csv")
    )  # fmt: skip
    _add_export(commands)
    _add_convert(commands)
    _add_cache(commands)
    return top


def _add(commands: Any, name: str, what: str, example: str, *, json_facts: bool = True) -> argparse.ArgumentParser:
    sub = cast(
        argparse.ArgumentParser,
        commands.add_parser(
            name,
            help=what,
            description=what[0].upper() + what[1:] + ".",
            epilog=f"example: {example}",
            formatter_class=argparse.RawDescriptionHelpFormatter,
        ),
    )
    sub.add_argument("--quiet", action="store_true", help="no progress")
    if json_facts:
        sub.add_argument("--json", action="store_true", help="print facts as JSON")
    return sub


def _add_recursive(sub: argparse.ArgumentParser) -> None:
    sub.add_argument("--recursive", action="store_true", help="also search subfolders of the given folders")


def _add_demo(commands: Any) -> None:
    sub = _add(commands, "demo", "both experiments of the paper, ending in a report", "shapespace demo --quick")
    sub.add_argument("--out", type=Path, default=Path("shapespace-demo"), metavar="DIR", help="where to write")
    sub.add_argument("--quick", action="store_true", help="coarser scans and an earlier stop, under a minute")
    sub.add_argument("--no-open", action="store_true", help="do not open the report in a browser")
    sub.set_defaults(run=run.demo)


def _add_data(commands: Any) -> None:
    sub = commands.add_parser("data", help="open data sets, simulated faces, organs and bones").add_subparsers(
        required=True, metavar="list|get|faces|organs|bones"
    )
    listing = _add(sub, "list", "open data sets: licence, size, hash", "shapespace data list")
    listing.set_defaults(run=run.data_list)
    get = _add(sub, "get", "download and verify an open data set", "shapespace data get ict-facekit")
    get.add_argument("name", metavar="NAME")
    get.add_argument("--to", type=Path, metavar="DIR", help="also copy it there")
    get.set_defaults(run=run.data_get)
    faces = _add(
        sub, "faces", "write simulated corresponded faces (PLY) with labels.csv",
        "shapespace data faces -o faces --subjects 100 --expressions neutral",
    )  # fmt: skip
    faces.add_argument("-o", "--output", type=Path, required=True, metavar="DIR", help="output folder")
    faces.add_argument("--subjects", type=_positive, default=100, metavar="N")
    faces.add_argument("--expressions", default="neutral", metavar="LIST", help="names with commas between them")
    faces.add_argument("--seed", type=_natural, default=0, metavar="S", help="random seed (default 0)")
    faces.add_argument("--source", choices=("bundled", "ict-facekit"), default="bundled")
    faces.add_argument("--area", choices=("face", "face_and_head"),
                       help="what to write (default: face of ict-facekit, face_and_head of bundled)")  # fmt: skip
    faces.add_argument("--raw", action="store_true",
                       help="raw scans: other triangles, any pose, noise, holes; not in correspondence")  # fmt: skip
    faces.add_argument("--wide", action="store_true",
                       help="bundled people who vary as widely as real ones, for models of real scans")  # fmt: skip
    faces.add_argument("--intensity", type=_intensities, default=(1.0,), metavar="LIST",
                       help="of bundled expressions, with commas between them: one is drawn for each")  # fmt: skip
    faces.add_argument("--effect", type=float, metavar="MM",
                       help="write a sex and an age too, and give men a chin that stands out by MM more")  # fmt: skip
    faces.set_defaults(run=run.data_faces)
    organs = _add(sub, "organs", "write simulated organs, smooth as spleens: raw surfaces (PLY), or label volumes",
                  "shapespace data organs -o organs --count 40")  # fmt: skip
    organs.add_argument("-o", "--output", type=Path, required=True, metavar="DIR", help="output folder")
    organs.add_argument("--count", type=_positive, default=40, metavar="N")
    organs.add_argument("--seed", type=_natural, default=0, metavar="S", help="random seed (default 0)")
    organs.add_argument("--volumes", action="store_true", help="label volumes (NIfTI) of the same organs")
    organs.set_defaults(run=run.data_organs)
    bones = _add(sub, "bones", "write simulated bones of two groups: raw scans (PLY), and their table bones.csv",
                 "shapespace data bones -o bones --count 16")  # fmt: skip
    bones.add_argument("-o", "--output", type=Path, required=True, metavar="DIR", help="output folder")
    bones.add_argument("--count", type=_positive, default=16, metavar="N",
                       help="number of bones; the groups alternate (default 16)")  # fmt: skip
    bones.add_argument("--seed", type=_natural, default=0, metavar="S", help="random seed (default 0)")
    bones.add_argument("--effect", type=float, default=4.0, metavar="MM",
                       help="difference of the snout length between the two groups (default 4)")  # fmt: skip
    bones.set_defaults(run=run.data_bones)


def _add_surface(commands: Any) -> None:
    sub = _add(commands, "surface", "extract surfaces of labels from label volumes (NIfTI, NRRD), as PLY in RAS mm",
               "shapespace surface masks -o surfaces --label 1\n"
               "         shapespace fit model.h5 surfaces -o out --unit mm")  # fmt: skip
    sub.add_argument("volumes", nargs="+", type=Path, metavar="MASK", help="label volumes, or folders of them")
    sub.add_argument(
        "-o", "--output", type=Path, required=True, metavar="DIR", help="output folder; each surface is NAME.ply"
    )
    _add_recursive(sub)
    sub.add_argument("--label", type=_labels, metavar="N|N,N|all",
                     help="labels that form one object (default: the only label of the volume)")  # fmt: skip
    sub.add_argument("--smooth", type=_smoothing, default=1.3, metavar="S",
                     help="standard deviation of the smoothing in voxels (default 1.3; 0: none)")  # fmt: skip
    sub.add_argument("--keep-pieces", action="store_true",
                     help="keep all pieces and cavities (default: the largest piece, cavities filled)")  # fmt: skip
    sub.add_argument("--max-memory", type=_memory_bytes, metavar="SIZE",
                     help="memory limit for a volume and its surface, such as 8G or 500M; a volume that needs more is "
                          "refused before it is read (default: 4G, or 80 %% of the free memory if that is "
                          "less)")  # fmt: skip
    sub.set_defaults(run=run.surface)


def _add_check(commands: Any) -> None:
    sub = _add(commands, "check", "check meshes: contents, defects, and their repair before a fit",
               "shapespace check scan.obj")  # fmt: skip
    sub.add_argument("files", nargs="+", type=Path, metavar="FILE")
    _add_recursive(sub)
    _add_strict(sub)
    sub.set_defaults(run=run.check)


def _add_strict(sub: Any, more: str = "") -> None:
    sub.add_argument("--strict", action="store_true",
                     help="refuse scans with coordinates that are NaN or infinite (default: remove the triangles "
                          f"that use them){more}")  # fmt: skip


def _add_correspond(commands: Any) -> None:
    sub = _add(commands, "correspond", "bring raw scans into dense correspondence; no model is needed",
               "shapespace correspond scans -o same\n"
               "         shapespace build same -o model.h5")  # fmt: skip
    sub.add_argument("scans", nargs="+", metavar="SCAN",
                     help="scans of one kind of object: files, folders, patterns, addresses or lists "
                          "(.csv)")  # fmt: skip
    sub.add_argument("-o", "--output", type=Path, required=True, metavar="DIR", help="output folder")
    _add_recursive(sub)
    sub.add_argument("--template", type=Path, metavar="FILE",
                     help="template mesh, used unchanged (default: the scan closest to all others)")  # fmt: skip
    sub.add_argument("--model", type=Path, metavar="MODEL.h5",
                     help="shape model of such objects; its mean is the template")  # fmt: skip
    sub.add_argument("--landmarks", type=Path, metavar="DIR",
                     help="landmarks of all or some scans: files with the names of the scans and another "
                          "ending")  # fmt: skip
    sub.add_argument("--landmark-error", type=_share, default=0.02, metavar="SHARE",
                     help="standard deviation of the landmarks, as a share of the object's size (default "
                          "0.02)")  # fmt: skip
    sub.add_argument("--symmetric", action="store_true", help="the object is its own mirror image")
    sub.add_argument("--vertices", type=_positive, default=10_000, metavar="N",
                     help="vertices of the template if it is one of the scans (default 10000)")  # fmt: skip
    sub.add_argument("--rounds", type=_positive, default=3, metavar="N", help="maximum number of rounds (default 3)")
    _add_strict(sub)
    _add_where(sub, "scans")
    sub.add_argument("--seed", type=_natural, default=0, metavar="S", help="random seed (default 0)")
    sub.set_defaults(run=run.correspond, goes_on="; the same command goes on from there")


def _add_build(commands: Any) -> None:
    sub = _add(commands, "build", "build a shape model from corresponding meshes: Procrustes and PCA",
               "shapespace build faces/*.ply -o model.h5 --modes auto")  # fmt: skip
    sub.add_argument("meshes", nargs="+", type=Path, metavar="MESH", help="mesh files or folders of them")
    sub.add_argument("-o", "--output", type=Path, required=True, metavar="MODEL.h5")
    _add_recursive(sub)
    sub.add_argument("--with-doubtful", action="store_true",
                     help="take surfaces of doubtful fits too, which are left out otherwise")  # fmt: skip
    how_many = sub.add_mutually_exclusive_group()
    how_many.add_argument("--variance", type=_share, metavar="SHARE", help="modes that hold this share, such as 0.98")
    how_many.add_argument("--modes", type=_modes, default="auto", metavar="K|auto|all",
                          help="a number; auto for cross-validation on held-out vertices (default); all")  # fmt: skip
    sub.add_argument("--gauge", choices=("form", "shape"),
                     help="form: size lives in the modes; shape: size is divided out (default)")  # fmt: skip
    sub.add_argument("--representation", choices=("vertices", "bspline", "bspline-detail"), default="vertices",
                     help="what the modes move: vertices (default), or control points of a B-spline surface, without "
                          "or with the detail of the mean that it cannot hold")  # fmt: skip
    sub.add_argument("--control-points", type=_control_points, metavar="MxN", help="of a B-spline (default 24x24)")
    sub.add_argument("--min-seen", type=_share, metavar="SHARE",
                     help="take out vertices (nan in the files: missing) that fewer than this share of the meshes show "
                          "(a half where it is left out)")  # fmt: skip
    sub.add_argument("--additive", type=Path, metavar="LABELS.csv",
                     help="part identity and expression: CSV of file, subject and label (one is neutral); --modes or "
                          "--variance then count modes of identity (default 0.995 of the variance)")  # fmt: skip
    sub.add_argument("--expression-variance", type=_share, metavar="SHARE",
                     help="with --additive: modes of expression that hold this share (default 0.99)")  # fmt: skip
    sub.add_argument("--out-of-core", action="store_true",
                     help="stream the meshes through a file beside the model, as is done where they would take more "
                          "than four fifths of the free memory; a build that is killed goes on there")  # fmt: skip
    sub.add_argument("--keep-shapes", action="store_true",
                     help="keep that file in MODEL.h5.shapes, for --add (4 bytes a coordinate of a mesh)")  # fmt: skip
    sub.add_argument("--add", type=Path, metavar="OLD.h5",
                     help="add the meshes to this model, which was built with --keep-shapes")  # fmt: skip
    sub.add_argument("--no-align", action="store_true", help="take the meshes as they stand")
    sub.add_argument("--unit", choices=_UNITS[1:], default="mm", help="of the meshes (default mm)")
    sub.add_argument("--landmarks", type=Path, metavar="FILE",
                     help="CSV of name,vertex, or points on the first mesh")  # fmt: skip
    sub.add_argument("--region", type=_named_file, action="append", default=[], metavar="NAME=FILE",
                     help="a part of the surface to hold fits to: a CSV file of vertices; can be repeated")  # fmt: skip
    sub.add_argument("--provenance", default="", metavar="TEXT", help="what the meshes are")
    sub.add_argument("--licence", default="", metavar="TEXT", help="of the meshes")
    sub.add_argument("--seed", type=_natural, default=0, metavar="S", help="random seed (default 0)")
    sub.set_defaults(run=run.build)


def _add_quality(commands: Any) -> None:
    sub = _add(commands, "quality", "measure a shape model: compactness, generalisation, specificity",
               "shapespace quality faces -o quality\n"
               "         shapespace quality registered_a registered_b --scans scans -o quality")  # fmt: skip
    sub.add_argument("targets", nargs="+", type=Path, metavar="TARGET",
                     help="a folder of meshes in correspondence or a model; two are compared")  # fmt: skip
    sub.add_argument("-o", "--output", type=Path, required=True, metavar="DIR",
                     help="where to write quality.json and the curves")  # fmt: skip
    sub.add_argument("--scans", type=Path, metavar="FOLDER",
                     help="judge surfaces against these scans, named as they are and in their pose")  # fmt: skip
    sub.add_argument("--unseen", type=Path, metavar="FOLDER",
                     help="also the error on these shapes in correspondence, which no model saw")  # fmt: skip
    sub.add_argument("--folds", type=_folds, default=10, metavar="N|loo",
                     help="in how many parts shapes are left out (default 10); loo: one shape at a time")  # fmt: skip
    sub.add_argument("--modes", type=_positive, metavar="K", help="the largest number of modes (default: all)")
    sub.add_argument("--samples", type=_positive, default=100, metavar="N", help="random shapes (default 100)")
    sub.add_argument("--gauge", choices=("form", "shape"), default="shape", help="as of build (default shape)")
    sub.add_argument("--no-align", action="store_true", help="take the meshes as they stand")
    sub.add_argument("--representation", nargs="+", choices=("vertices", "bspline", "bspline-detail"),
                     default=["vertices"], help="as of build; two are compared")  # fmt: skip
    sub.add_argument("--control-points", type=_control_points, metavar="MxN", help="of a B-spline (default 24x24)")
    sub.add_argument("--seed", type=_natural, default=0, metavar="S", help="of folds and samples")
    _add_where(sub, "folds")
    sub.set_defaults(run=run.quality)


def _add_info(commands: Any) -> None:
    sub = _add(commands, "info", "print facts of a model, a mesh, a fit, a store or a folder of correspond",
               "shapespace info model.h5")  # fmt: skip
    sub.add_argument(
        "file", type=Path, metavar="FILE|DIR", help="a model, a mesh, a record, a store, or what correspond wrote"
    )
    sub.set_defaults(run=run.info)


def _add_fit(commands: Any) -> None:
    sub = _add(commands, "fit", "fit a model to raw scans: coefficients, pose and fitted surfaces",
               "shapespace fit model.h5 scan.obj -o out\n"
               "         shapespace fit model.h5 scans -o out --dense\n"
               "         shapespace build out/*.dense.ply -o new.h5")  # fmt: skip
    sub.add_argument("model", type=Path, metavar="MODEL.h5")
    sub.add_argument("scans", nargs="+", metavar="SCAN",
                     help="scans, folders, patterns, addresses such as s3://bucket/x, or lists of these")  # fmt: skip
    sub.add_argument("-o", "--output", type=Path, required=True, metavar="DIR",
                     help="output folder; existing valid results are reused")  # fmt: skip
    _add_recursive(sub)
    sub.add_argument(
        "--method",
        default="robust",
        metavar="NAME",
        help="robust (default): pose and shape jointly, from distances in both directions; paper: the paper's "
        "modified ICP",
    )
    sub.add_argument("--unit", choices=_UNITS, default="auto",
                     help="unit of the scans (default: detected)")  # fmt: skip
    sub.add_argument("--search", choices=("auto", "vertices", "surface"), default="auto",
                     help="closest points of --method paper: vertices of the scan (auto) or points on its "
                          "triangles")  # fmt: skip
    sub.add_argument("--scale", choices=("auto", "free", "fixed"), default="auto",
                     help="estimate the scale or keep it fixed; auto: free if the model's gauge is shape, fixed if "
                          "it is form")  # fmt: skip
    sub.add_argument("--max-iterations", type=_positive, default=500, metavar="N",
                     help="maximum number of iterations of each phase (default 500)")  # fmt: skip
    sub.add_argument("--landmarks", type=Path, metavar="FILE|DIR",
                     help="landmarks that initialise and constrain the fit, with the names of the model's landmarks: "
                          "a file for one scan, or a folder with a file for each scan, named after it; a list of "
                          "scans may have a column landmarks instead")  # fmt: skip
    sub.add_argument("--landmark-sd", type=_stddev, metavar="MM",
                     help="standard deviation of the landmarks (default: 3 %% of the model's size); inf: they only "
                          "initialise the fit")  # fmt: skip
    sub.add_argument("--crop", default="", metavar="KIND:NUMBERS",
                     help="fit only the part of the scan inside sphere:X,Y,Z,R or box:X,Y,Z,X,Y,Z (in its frame and "
                          "unit), or landmarks:MM, within this distance in mm of the landmarks")  # fmt: skip
    sub.add_argument("--region", metavar="NAME|FILE.csv",
                     help="restrict the fit, its distances and its status to a region of the model: its name, or a "
                          "CSV file of vertices")  # fmt: skip
    _add_where(sub, "scans")
    results = sub.add_mutually_exclusive_group()
    results.add_argument("--again", action="store_true", help="fit all scans again, also those with valid results")
    # It has no effect; to be removed after the next release.
    results.add_argument("--resume", action="store_true", help=argparse.SUPPRESS)
    sub.add_argument("--dense", action="store_true",
                     help="also write NAME.dense.ply, the fitted surface deformed further onto the scan")  # fmt: skip
    sub.add_argument("--stages", action="store_true", help="also write NAME.stages.npz, for figures")
    sub.add_argument("--store", action="store_true",
                     help="write the results to few files (the default from 10,000 scans on)")  # fmt: skip
    _add_strict(sub, "; exit with 1 when a fit is doubtful")
    sub.add_argument("--seed", type=_natural, default=0, metavar="S", help="random seed (default 0)")
    sub.set_defaults(run=run.fit, goes_on="; the same command goes on from there")


def _add_view(commands: Any) -> None:
    sub = _add(commands, "view", "view a shape model, fits or surfaces in correspondence in the browser",
               "shapespace view model.h5", json_facts=False)  # fmt: skip
    sub.add_argument(
        "path", type=Path, metavar="MODEL.h5|DIR", help="a model, or a folder that fit or correspond wrote"
    )
    sub.add_argument("--model", type=Path, metavar="MODEL.h5", help="of the fits in DIR (default: named in them)")
    sub.add_argument("--host", default="127.0.0.1", metavar="H", help="address to listen at (default 127.0.0.1)")
    sub.add_argument("--port", type=_natural, metavar="N", help="default: the first free one from 7860")
    sub.add_argument("--no-open", action="store_true", help="do not open a browser")
    sub.add_argument("--max-upload-mb", type=_positive, default=200, metavar="N", help="largest scan (default 200)")
    sub.set_defaults(run=run.view)


def _add_report(commands: Any) -> None:
    sub = _add(commands, "report", "write one HTML report of the fits, correspondence or study in a folder",
               "shapespace fit model.h5 scans -o out --stages\n         shapespace report out")  # fmt: skip
    sub.add_argument("folder", type=Path, metavar="DIR", help="written by shapespace fit, correspond or demo")
    sub.add_argument("-o", "--output", type=Path, metavar="FILE.html", help="the report (default DIR/report.html)")
    sub.add_argument("--model", type=Path, metavar="MODEL.h5", help="where the model is now, if it was moved")
    sub.add_argument("--labels", type=Path, metavar="FILE",
                     help="table of scans and labels (default: labels.csv in DIR or beside the scans)")  # fmt: skip
    sub.add_argument("--no-open", action="store_true", help="do not open the report in a browser")
    sub.set_defaults(run=run.report)


def _add_export(commands: Any) -> None:
    sub = _add(commands, "export", "export the fits of a store as single files, or as one table",
               "shapespace export out anna ben -o single\n"
               "         shapespace export out --table fits.csv")  # fmt: skip
    sub.add_argument("store", type=Path, metavar="STORE", help="a folder that shapespace fit wrote")
    sub.add_argument("names", nargs="*", metavar="NAME", help="of the fits")
    sub.add_argument("-o", "--output", type=Path, default=Path("exported"), metavar="DIR",
                     help="where to write (default exported)")  # fmt: skip
    sub.add_argument("--all", action="store_true", help="all fits")
    sub.add_argument("--table", type=Path, metavar="FILE",
                     help="the coefficients of all fits: FILE.csv, or FILE.mat for MATLAB")  # fmt: skip
    sub.set_defaults(run=run.export)


def _add_convert(commands: Any) -> None:
    sub = _add(commands, "convert", "convert a shape model from or to the format of another tool",
               "shapespace convert femur.h5.json femur.h5\n"
               "         shapespace convert model.h5 model.bin --to eos")  # fmt: skip
    sub.add_argument("source", type=Path, metavar="IN", help="a model in any format that is read")
    sub.add_argument("output", type=Path, metavar="OUT", help="its extension sets the format; .h5 is shapespace's own")
    sub.add_argument("--to", metavar="FORMAT", help="the format by its name, if the extension does not determine it")
    sub.add_argument("--unit", choices=("um", "mm", "cm", "inch", "m"), help="of IN, where its format does not say")
    sub.add_argument("--expressions", type=Path, metavar="FILE.bin",
                     help="blendshapes that eos keeps in a file of their own")  # fmt: skip
    sub.set_defaults(run=run.convert)


def _add_cache(commands: Any) -> None:
    sub = _add(commands, "cache", "print the folder and size of the cache, or clear it", "shapespace cache --clear")
    sub.add_argument("--clear", action="store_true", help="remove all entries; fits compute them again")
    sub.set_defaults(run=run.cache)


def _add_recognise(commands: Any) -> None:
    sub = commands.add_parser(
        "recognise", help="classify scans (for example, facial expressions) by fitted coefficients"
    )
    sub = sub.add_subparsers(required=True, metavar="train|predict|transfer|study|verify|identify")
    _add_recognise_train(sub)
    _add_recognise_predict(sub)
    _add_recognise_transfer(sub)
    _add_recognise_study(sub)
    identity.add_verify(
        _add(sub, "verify", "test whether two scans are of one subject: error rates, likelihood ratios",
             "shapespace recognise verify scans.csv -o verified --gallery session=1")
    )  # fmt: skip
    identity.add_identify(
        _add(sub, "identify", "identify the subject of a scan among the enrolled ones: ranks and error rates",
             "shapespace recognise identify scans.csv -o identified --gallery expression=neutral")
    )  # fmt: skip


def _add_recognise_train(commands: Any) -> None:
    sub = _add(commands, "train", "train a classifier on fitted scans with labels",
               "shapespace recognise train out --labels labels.csv -o expressions.skops\n"
               "         shapespace recognise train out --labels labels.csv -o expressions.skops --relative "
               "--classifier mean-direction")  # fmt: skip
    sub.add_argument("results", type=Path, metavar="RESULTS", help="a folder that fit wrote, or its coefficients.csv")
    sub.add_argument("--labels", type=Path, required=True, metavar="FILE",
                     help="table of scans and their labels, and subjects if known")  # fmt: skip
    sub.add_argument("-o", "--output", type=Path, required=True, metavar="FILE.skops")
    sub.add_argument("--classifier", default="lda", metavar="NAME",
                     help="mean-direction, knn, lda (default), qda, logistic or svm")  # fmt: skip
    sub.add_argument("--relative", action="store_true", help="compare each scan with its subject's neutral face")
    sub.add_argument("--neutral", default="neutral", metavar="LABEL", help="label of neutral faces (default neutral)")
    sub.add_argument("--confidence", type=_probability, default=0.5, metavar="P",
                     help="answer unsure below this probability (default 0.5)")  # fmt: skip
    sub.add_argument("--modes", type=_positive, metavar="K", help="leading coefficients to see (default: all)")
    sub.add_argument("--expression-of", type=Path, metavar="MODEL.h5",
                     help="see the expression alone, as parted by this model of build --additive")  # fmt: skip
    sub.add_argument("--seed", type=_natural, default=0, metavar="S", help="random seed (default 0)")
    sub.set_defaults(run=run.recognise_train)


def _add_recognise_predict(commands: Any) -> None:
    sub = _add(commands, "predict", "answer for fitted scans by a trained classifier, as a CSV table",
               "shapespace recognise predict expressions.skops out -o predictions.csv")  # fmt: skip
    sub.add_argument("classifier", type=Path, metavar="FILE.skops")
    sub.add_argument("results", type=Path, metavar="RESULTS", help="a folder that fit wrote, or its coefficients.csv")
    sub.add_argument("--labels", type=Path, metavar="FILE",
                     help="CSV of file, label and subject: says which scans are neutral faces, and whose")  # fmt: skip
    sub.add_argument("-o", "--output", type=Path, required=True, metavar="FILE.csv")
    sub.add_argument("--strict", action="store_true", help="exit with 1 when a fit is doubtful or an answer unsure")
    sub.set_defaults(run=run.recognise_predict)


def _add_recognise_transfer(commands: Any) -> None:
    sub = _add(commands, "transfer", "put one person's expression on another, from fits by an additive model",
               "shapespace recognise transfer model.h5 out/anna.fit.json out/ben.fit.json -o anna.ply")  # fmt: skip
    sub.add_argument("model", type=Path, metavar="MODEL.h5", help="made by build --additive LABELS.csv")
    sub.add_argument("person", type=Path, metavar="PERSON.fit.json", help="fit of who is to be shown")
    sub.add_argument("expression", type=Path, metavar="EXPRESSION.fit.json", help="fit of what they shall do")
    sub.add_argument("-o", "--output", type=Path, required=True, metavar="FILE.ply")
    sub.set_defaults(run=run.recognise_transfer)


def _add_recognise_study(commands: Any) -> None:
    sub = _add(commands, "study", "recognition measured on unseen subjects, ending in a report",
               "shapespace recognise study --data BU-3DFE --model model.h5 -o study")  # fmt: skip
    sub.add_argument("-o", "--output", type=Path, default=Path("shapespace-study"), metavar="DIR",
                     help="where to write; a study that was interrupted goes on")  # fmt: skip
    sub.add_argument("--data", type=Path, metavar="DIR",
                     help="labelled scans: BU-3DFE, Bosphorus, or a folder with labels.csv")  # fmt: skip
    sub.add_argument("--model", type=Path, metavar="MODEL.h5", help="shape model that fits them")
    sub.add_argument("--folds", type=_positive, default=10, metavar="N", help="folds by subject (default 10)")
    sub.add_argument("--seed", type=_natural, default=0, metavar="S", help="of everything that is drawn")
    _add_where(sub, "fits")
    sub.add_argument("--no-open", action="store_true", help="do not open the report in a browser")
    sub.set_defaults(run=run.recognise_study, goes_on="; the same command goes on from there")


def _add_where(sub: argparse.ArgumentParser, what: str) -> None:
    sub.add_argument(
        "--jobs", type=_natural, default=0, metavar="N", help=f"{what} in parallel (default: one per core)"
    )
    sub.add_argument("--executor", choices=_EXECUTORS, default="local",
                     help="local (default): processes on this machine; serial: one after the other; dask: a Dask "
                          "cluster")  # fmt: skip
    sub.add_argument("--dask", metavar="ADDRESS",
                     help="address of a Dask scheduler, such as tcp://10.0.0.5:8786, or its scheduler file (.json); "
                          "without it --executor dask starts a cluster on this machine")  # fmt: skip
    sub.add_argument("--timeout", type=_seconds, metavar="S",
                     help=f"skip any of the {what} that takes longer than S seconds")  # fmt: skip


def _seconds(text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = 0.0
    if not 0 < value < float("inf"):
        raise argparse.ArgumentTypeError(f"must be seconds above 0, not {text!r}")
    return value


def _positive(text: str) -> int:
    value = _natural(text)
    if value == 0:
        raise argparse.ArgumentTypeError("must be at least 1")
    return value


def _folds(text: str) -> int | None:
    if text == "loo":
        return None
    value = _natural(text)
    if value < 2:
        raise argparse.ArgumentTypeError("must be at least 2, or loo")
    return value


def _natural(text: str) -> int:
    try:
        value = int(text)
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r} is not a whole number") from None
    if value < 0:
        raise argparse.ArgumentTypeError("must not be negative")
    return value


def _share(text: str) -> float:
    value = _probability(text)
    if value == 0:
        raise argparse.ArgumentTypeError("must lie above 0 and at most at 1")
    return value


def _probability(text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r} is not a number") from None
    if not 0 <= value <= 1:
        raise argparse.ArgumentTypeError("must lie from 0 to 1")
    return value


def _control_points(text: str) -> tuple[int, int]:
    counts = text.lower().split("x")
    if len(counts) != 2 or not all(count.isascii() and count.isdigit() and len(count) < 4 for count in counts):
        raise argparse.ArgumentTypeError(f"must be two whole numbers such as 24x24, not {text!r}")
    return int(counts[0]), int(counts[1])


def _intensities(text: str) -> tuple[float, ...]:
    return tuple(_share(one) for one in text.split(","))


def _named_file(text: str) -> tuple[str, Path]:
    name, equals, file = text.partition("=")
    if not (name.strip() and equals and file):
        raise argparse.ArgumentTypeError(f"must be NAME=FILE, not {text!r}")
    return name.strip(), Path(file)


def _stddev(text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = 0.0
    if not value > 0:
        raise argparse.ArgumentTypeError(f"must be a number of millimetres above 0, or inf, not {text!r}")
    return value


def _memory_bytes(text: str) -> int:
    found = re.fullmatch(r"(\d{1,9}(?:\.\d{1,6})?)([KMGT])(?:i?B)?", text, re.IGNORECASE | re.ASCII)
    value = float(found[1]) * 1024 ** (1 + "KMGT".index(found[2].upper())) if found else 0.0
    if not value:
        raise argparse.ArgumentTypeError(f"must be a size such as 8G or 500M, not {text!r}")
    return int(value)


def _smoothing(text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = -1.0
    if not 0 <= value <= 10:
        raise argparse.ArgumentTypeError(f"must be a number from 0 to 10, not {text!r}")
    return value


def _labels(text: str) -> str | tuple[int, ...]:
    if text == "all":
        return text
    try:
        labels = tuple(int(part) for part in text.split(","))
    except ValueError:
        labels = (0,)
    if 0 in labels:
        raise argparse.ArgumentTypeError(f"must be all, or whole numbers other than 0 such as 1 or 1,2, not {text!r}")
    return labels


def _modes(text: str) -> int | str:
    return text if text in ("auto", "all") else _positive(text)
