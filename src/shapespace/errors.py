"""Exceptions of shapespace, each with one sentence on the problem, the file or argument, and the remedy."""


class ShapespaceError(Exception):
    """Base of every error that shapespace raises on purpose.

    Example:
        >>> try:
        ...     ss.build_model(meshes[:1])
        ... except ss.ShapespaceError as error:
        ...     print(error)
        A shape model needs at least two meshes, not 1; one mesh has no variation.
    """


class InputError(ShapespaceError, ValueError):
    """An argument or an array has the wrong shape, type or value."""


class MeshError(InputError):
    """A surface cannot be used: no points, not finite, degenerate, or faces with invalid indices."""


class CorrespondenceError(InputError):
    """Meshes, or a mesh and a model, do not share their vertices or their triangles."""


class FileError(ShapespaceError, OSError):
    """A file cannot be read or written; the message names the file."""


class FileFormatError(FileError, ValueError):
    """A file is not in the expected format, or it is cut short or damaged."""


class ModelFileError(FileFormatError):
    """A model file is damaged, of an unknown version, or not a shapespace model."""


class DataError(ShapespaceError):
    """An open data set is missing, could not be downloaded, or does not match its published hash."""


class FitError(ShapespaceError):
    """A scan cannot be fitted; a poor fit is not an error but a result with a status."""
