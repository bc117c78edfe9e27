"""A trained regressor on a phone or any small machine: the bundle that `groundwalk export --format phone` writes.

`open_bundle("bundle").predict("image.jpg", intrinsics=...)`. Needs numpy, OpenCV and ONNX Runtime, and loads nothing of
what training needs.
"""

from groundwalk.runtime.bundle import Bundle, Prediction, open_bundle

__all__ = ["Bundle", "Prediction", "open_bundle"]
