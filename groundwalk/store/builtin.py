"""The entries that groundwalk brings itself, group by group, in the order in which they are listed, tried and shown.

Each line is an entry point, name = "module:record". They stand here and not in pyproject.toml because an entry point's
metadata is written when a package is installed, sorted by name: docs/explanation/decisions.md.
"""

_FORMATS_ELSEWHERE = {
    "3d_scanner_app": "scanner_app:FORMAT",
    **{name: f"poses_only:{name.upper()}" for name in ("arkit_logger", "arcore_logger", "invisible_map")},
}

BUILTIN: dict[str, dict[str, str]] = {
    "groundwalk.formats": {
        name: f"groundwalk.capture_import.formats.{_FORMATS_ELSEWHERE.get(name, f'{name}:FORMAT')}"
        for name in (
            "3d_scanner_app",
            "stray_scanner",
            "record3d",
            "polycam",
            "nerf_capture",
            "scan_capture",
            "ios_logger",
            "spectacular_ai",
            "frames_jsonl",
            "arkit_logger",
            "arcore_logger",
            "invisible_map",
            "arkit_scenes",
            "euroc",
            "tum",
            "rtabmap",
            "kitti",
            "seven_scenes",
            "cambridge",
            "colmap",
            "nerfstudio",
            "llff",
            "photos",
            "video",
        )
    },
    "groundwalk.mappers": {
        "incremental": "groundwalk.sfm.plugins:INCREMENTAL",
        "global": "groundwalk.sfm.plugins:GLOBAL",
        "hierarchical": "groundwalk.sfm.plugins:HIERARCHICAL",
    },
    "groundwalk.structure_localisers": {
        "Map": "groundwalk.localisation.entries:MAP",
        "HLoc": "groundwalk.localisation.entries:HLOC",
        "HLoc-XFeat": "groundwalk.localisation.entries:HLOC_XFEAT",
    },
    "groundwalk.regressors": {
        "PN": "groundwalk.training.entries:PN",
        "MS-T": "groundwalk.training.entries:MS_T",
        "PN-Lite": "groundwalk.training.entries:PN_LITE",
    },
    "groundwalk.fusion_methods": {
        "raw": "groundwalk.fusion.methods.entries:RAW",
        "paper_rule": "groundwalk.fusion.methods.entries:PAPER_RULE",
        "last_good": "groundwalk.fusion.methods.entries:LAST_GOOD",
        "window30": "groundwalk.fusion.methods.entries:WINDOW30",
        "pose_graph": "groundwalk.fusion.methods.entries:POSE_GRAPH",
        "error_state": "groundwalk.fusion.methods.entries:ERROR_STATE",
        "drift_aware": "groundwalk.fusion.methods.entries:DRIFT_AWARE",
        "smoother": "groundwalk.fusion.methods.entries:SMOOTHER",
        "vio_oracle": "groundwalk.fusion.methods.entries:VIO_ORACLE",
    },
    "groundwalk.exporters": {
        "colmap": "groundwalk.export.entries:COLMAP",
        "colmap-text": "groundwalk.export.entries:COLMAP_TEXT",
        "tum": "groundwalk.export.entries:TUM",
        "nerfstudio": "groundwalk.export.entries:NERFSTUDIO",
        "7scenes": "groundwalk.export.entries:SEVEN_SCENES",
        "cambridge": "groundwalk.export.entries:CAMBRIDGE",
        "hloc": "groundwalk.export.entries:HLOC",
        "kapture": "groundwalk.export.entries:KAPTURE",
        "huggingface": "groundwalk.export.entries:HUGGINGFACE",
    },
}
