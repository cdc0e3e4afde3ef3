"""Lists the nodes, topics and services that ROS discovers. Commands: `graph`, `endpoints`."""

from typing import Any

from tests.ros2.programs.console import endpoints, start


def main() -> None:
    """Run until stdin ends."""
    console = start()
    node = console.node

    def graph() -> dict[str, Any]:
        nodes = node.get_node_names_and_namespaces()
        return {
            "nodes": sorted(f"{space.rstrip('/')}/{name}" for name, space in nodes),
            "topics": dict(node.get_topic_names_and_types()),
            "services": dict(node.get_service_names_and_types()),
        }

    console.commands |= {
        "graph": graph,
        "endpoints": lambda topic: endpoints(node, topic),
    }
    console.run()


if __name__ == "__main__":
    main()
