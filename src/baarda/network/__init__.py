"""The network: who was measured, from where, with what, and what is known beforehand."""

from baarda.network.declared import Declared
from baarda.network.network import AXES, CHECK, CONTROL, EXTERIOR, ROLES, TIE, Images, Network, Points
from baarda.network.parameters import State, UnknownGroup, Unknowns, unknowns_of
from baarda.network.tables import Table
from baarda.network.viewpoints import Viewpoints

__all__ = [
    "AXES",
    "CHECK",
    "CONTROL",
    "EXTERIOR",
    "ROLES",
    "TIE",
    "Declared",
    "Images",
    "Network",
    "Points",
    "State",
    "Table",
    "UnknownGroup",
    "Unknowns",
    "Viewpoints",
    "unknowns_of",
]
