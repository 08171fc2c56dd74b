"""File containers with bounds on what they may cost to read: archives, HDF5, JSON.

Entry points: `archives`, `hdf5`, `json_files`. Imported by the readers beside it and by `model`, `recognise` and
`store`.
"""
