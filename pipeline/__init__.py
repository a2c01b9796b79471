"""The ground floor: orchestration, geometry, files and models. Never imports a stage."""
