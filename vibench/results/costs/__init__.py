"""What models cost: seconds compared within rounds, break-even, who ranks where, and the cheapest."""
