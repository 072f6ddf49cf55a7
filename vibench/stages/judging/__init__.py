"""What is measured of the answers of a cell, whoever gives them: pairs u_N and λ_N, their rows, their summary."""
