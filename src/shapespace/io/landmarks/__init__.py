"""Readers and writers of landmark files of other programs.

Entry points: `landmark_io.read_landmarks`, `landmark_io.write_landmarks`. Imported by every layer above `geometry`.
"""
