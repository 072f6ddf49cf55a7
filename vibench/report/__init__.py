"""What a run found: findings, HTML report, figures, comparison of runs, replay and export of programs."""
