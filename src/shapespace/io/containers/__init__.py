"""File containers that are read within limits of memory and time: archives, HDF5, JSON.

Entry points: `archives`, `hdf5`, `json_files`. Imported by the readers of `io` and by `model`, `recognise`
and `store`.
"""
