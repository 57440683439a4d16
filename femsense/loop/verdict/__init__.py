"""The result of a search: verdict, returned robot, confounded effects."""
