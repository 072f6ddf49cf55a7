"""Artefacts: results of stages as files of arrays and JSON, under the hash of their inputs."""
