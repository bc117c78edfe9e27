"""What the report stage writes: every number of its tables with where it comes from, and what was checked."""

from groundwalk.store.schemas import Column, TableSchema

_SOURCE = Column("source", "string", "ours (computed in this run) or published (printed in the paper)")

TABLES = [
    TableSchema(
        "report",
        "cells",
        "Every number of Tables I to IV, one row a number.",
        [
            _SOURCE,
            Column(
                "table", "string", "I (dataset), II (errors), III (accuracy levels) or IV (all methods, all frames)"
            ),
            Column("environment", "string", "outdoor, indoor or unknown"),
            Column("scene", "string", "scene, or 'average' over the environment's scenes"),
            Column(
                "row",
                "string",
                "set of test frames: rp (reliable), opt (optimised), rp+opt, all (a missing pose fails), common "
                "(answered by every method); 'scene' in Table I",
            ),
            Column("column", "string", "heading: model, method and quantity"),
            Column("model", "string", "regressor; empty in Table I where a number isn't a model's"),
            Column("method", "string", "fusion method's id; raw is the prediction alone; empty in Table I"),
            Column("options", "string", "the method's options, JSON; empty where unknown or none"),
            Column("over", "string", "all (all test frames) or subset (the row's frames); empty in Table I"),
            Column("statistic", "string", "mean, median, level, share, coverage or value"),
            Column("quantity", "string", "translation, rotation, high, medium, low, frames, ..."),
            Column("value", "float64", "the number; null where it isn't defined or isn't a number", "", "", True),
            Column("text", "string", "as the tables print it"),
            Column("unit", "string", "m, deg, %, MiB, MB, ms or empty"),
            Column("source_rows", "int64", "rows that the number was computed from; 1 for a published one"),
            Column("source_table", "string", "the table or file that they are rows of"),
        ],
    ),
    TableSchema(
        "report",
        "checks",
        "What was checked of the printed tables and of the run, and what was found.",
        [
            _SOURCE,
            Column("check", "string", "name of the rule (docs/explanation/reports.md)"),
            Column("table", "string", "I to IV, or the artefact's table"),
            Column("scene", "string", "scene, or which scenes"),
            Column("subset", "string", "set of test frames"),
            Column("column", "string", "model, method and quantity"),
            Column("expected", "string", "what the rule gives"),
            Column("printed", "string", "what is printed"),
            Column("status", "string", "agrees, disagrees or caution"),
            Column("because", "string", "the rule in words"),
        ],
        version="2.0",
    ),
]
