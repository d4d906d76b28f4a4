"""Section 4.3: the optimal mass-preserving map, by a Lagrangian flow or by the paper's own scheme."""

from omtwarp.transport.flow import TransportMap, optimal_transport, transport_cost
from omtwarp.transport.paper import FlowResult, PaperFlow, paper_flow

__all__ = [
    "FlowResult",
    "PaperFlow",
    "TransportMap",
    "optimal_transport",
    "paper_flow",
    "transport_cost",
]
