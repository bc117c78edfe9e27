"""What the report stage writes: every number of its tables with where it comes from, and what was checked."""

from groundwalk.store.schemas import tables

TABLES = tables(
    "report",
    """
cells 1.0: Every number of Tables I to IV, one row a number.
    source (string): ours (computed in this run) or published (printed in the paper)
    table (string): I (dataset), II (errors), III (accuracy levels) or IV (all methods, all frames)
    environment (string): outdoor, indoor or unknown
    scene (string): scene, or 'average' over the environment's scenes
    row (string): set of test frames: rp (reliable), opt (optimised), rp+opt, all (a missing pose fails), common
        (answered by every method); 'scene' in Table I
    column (string): heading: model, method and quantity
    model (string): regressor; empty in Table I where a number isn't a model's
    method (string): fusion method's id; raw is the prediction alone; empty in Table I
    options (string): the method's options, JSON; empty where unknown or none
    over (string): all (all test frames) or subset (the row's frames); empty in Table I
    statistic (string): mean, median, level, share, coverage or value
    quantity (string): translation, rotation, high, medium, low, frames, ...
    value (float64?): the number; null where it isn't defined or isn't a number
    text (string): as the tables print it
    unit (string): m, deg, %, MiB, MB, ms or empty
    source_rows (int64): rows that the number was computed from; 1 for a published one
    source_table (string): the table or file that they are rows of

checks 2.0: What was checked of the printed tables and of the run, and what was found.
    source (string): ours (computed in this run) or published (printed in the paper)
    check (string): name of the rule (docs/explanation/reports.md)
    table (string): I to IV, or the artefact's table
    scene (string): scene, or which scenes
    subset (string): set of test frames
    column (string): model, method and quantity
    expected (string): what the rule gives
    printed (string): what is printed
    status (string): agrees, disagrees or caution
    because (string): the rule in words
""",
)
