"""Registration: warps of the sphere that bring the same place of two surfaces to the same point."""

from omtwarp.registration.folding import folding_features
from omtwarp.registration.group import GroupRegistration, register_group
from omtwarp.registration.group_template import Template
from omtwarp.registration.landmarks import Landmark, read_landmarks
from omtwarp.registration.register import Registration, register
from omtwarp.registration.sequence import SequenceRegistration, register_sequence

__all__ = [
    "GroupRegistration",
    "Landmark",
    "Registration",
    "SequenceRegistration",
    "Template",
    "folding_features",
    "read_landmarks",
    "register",
    "register_group",
    "register_sequence",
]
