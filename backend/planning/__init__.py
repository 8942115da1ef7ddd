"""What a scene needs and what it can do without, decided before any work: `plan` holds decisions, `decisions` makes
them from what `coverage` finds, `choosing` says which objects are made and which are one."""
