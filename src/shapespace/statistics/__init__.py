"""Statistical analyses of cohorts: groups, change, asymmetry, regression, identity, scores against a reference.

Entry points: `compare`, `change`, `measure_asymmetry`, `regress`, `score`, `verify` and `identify`.
May be imported by `report`, `viewer`, `study`, `commands` and `cli`; results contain no prose and no HTML.
"""
