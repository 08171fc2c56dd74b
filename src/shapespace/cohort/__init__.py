"""Shapes of many subjects with what is known of each: what every statistical answer begins from."""
