"""Faults on purpose: damaged artefacts and captures, hostile names and archives, kills, full disks, two runs at once.

`make test-faults` runs all of it and writes docs/results/faults.*; `make test` has a tenth. Stages are those of
groundwalk's registry: a new one is tried with what it `needs`, without a line here.
"""
