__all__ = [
    "ExportShapes",
    "ExportedProgram",
    "export",
    "load_exported",
]

from .folders import ExportedProgram, export, load_exported
from .programs import ExportShapes
