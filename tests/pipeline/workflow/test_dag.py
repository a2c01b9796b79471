"""The declaration of the flow is consistent."""

from pipeline.workflow import dag


def test_every_input_is_declared_before_it_is_used():
    """Also checks that it exists for every recording that requires it; what a home of several animals shares is
    read only for those recordings that have it.
    """
    declared: dict[str, dag.Node] = {}
    for node in dag.FLOW:
        for need in dag.needs_of(node):
            source = dag.NODES[need.artifact]
            if (
                need.artifact not in declared
            ):  # for some recordings, from others: sessions from the turnaround
                back = [each.roles for each in dag.needs_of(source) if each.artifact == node.artifact]
                assert need.readers, f"{node.artifact} needs {need.artifact}"
                assert all(roles and set(roles).isdisjoint(need.readers) for roles in back), node.artifact
            if node.roles and source.roles and not source.of_several:
                assert set(need.roles or node.roles) <= set(source.roles), (
                    f"{node.artifact}: no {need.artifact} for every role"
                )
        assert node.artifact not in declared, f"{node.artifact} is declared twice"
        declared[node.artifact] = node


def test_held_out_phone_is_not_used_by_models():
    for node in dag.FLOW:
        for need in dag.needs_of(node):
            roles = need.roles or (
                node.roles if need.artifact == "frames" else dag.NODES[need.artifact].roles
            )
            assert "heldout" not in roles or node.artifact in {
                "frames",
                "reconstruction_metrics",
                "report",
            }, node.artifact


def test_feature_basis_does_not_use_the_test_session():
    (need,) = dag.needs_of(dag.NODES["feature_basis"])
    assert "test" not in need.splits


def test_stages_with_two_artifacts_have_two_tables():
    assert dag.table_of(dag.NODES["scene_localizer"]) == "scene_localizer"
    assert dag.table_of(dag.NODES["masks"]) == "segment_agent"
