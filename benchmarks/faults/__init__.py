"""Faults on purpose: damaged artefacts, kills, full disks, two runs at once, tried on a finished scene.

`make test-faults` runs all of it and writes docs/results/faults.*. Stages are those of groundwalk's registry: a new one
is tried with what it `needs`, without a line here. Hostile captures, archives, names and predictions have tests.
"""
