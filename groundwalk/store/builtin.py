"""The entries that groundwalk brings itself, group by group, in the order in which they are listed, tried and shown.

Each is an entry point, name = "module:record". They stand here and not in pyproject.toml because an entry point's
metadata is written when a package is installed, sorted by name: docs/explanation/decisions.md.
"""


def _records(module: str, *names: str) -> dict[str, str]:
    """Entries whose records in a module of groundwalk have their names, as constants are written: MS_T of MS-T."""
    return {name: f"groundwalk.{module}:{name.upper().replace('-', '_')}" for name in names}


def _formats(*names: str) -> dict[str, str]:
    """Capture formats, each the record FORMAT of a module of its own."""
    return {name: f"groundwalk.capture_import.formats.{name}:FORMAT" for name in names}


BUILTIN: dict[str, dict[str, str]] = {
    "groundwalk.formats": {
        "3d_scanner_app": "groundwalk.capture_import.formats.scanner_app:FORMAT",
        **_formats("stray_scanner", "record3d", "polycam", "nerf_capture", "scan_capture", "ios_logger"),
        **_formats("spectacular_ai", "frames_jsonl"),
        **_records("capture_import.formats.poses_only", "arkit_logger", "arcore_logger", "invisible_map"),
        **_formats("arkit_scenes", "euroc", "tum", "rtabmap", "kitti", "seven_scenes", "cambridge", "colmap"),
        **_formats("nerfstudio", "llff", "pose_list", "photos", "video"),
    },
    "groundwalk.mappers": _records("sfm.plugins", "incremental", "global"),
    "groundwalk.structure_localisers": _records("localisation.entries", "Map", "HLoc", "HLoc-XFeat"),
    "groundwalk.regressors": _records("training.entries", "PN", "MS-T", "PN-Lite"),
    "groundwalk.fusion_methods": {
        **_records("fusion.methods.entries", "raw", "paper_rule", "last_good", "window30", "pose_graph"),
        **_records("fusion.methods.entries", "global_graph", "error_state", "drift_aware", "smoother", "vio_oracle"),
    },
    "groundwalk.exporters": {
        **_records("export.entries", "colmap", "colmap-text", "tum", "nerfstudio", "splat"),
        "7scenes": "groundwalk.export.entries:SEVEN_SCENES",
        **_records("export.entries", "cambridge", "euroc", "hloc", "kapture", "huggingface"),
    },
}
