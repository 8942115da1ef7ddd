"""What a scene needs and what it can do without, decided before any work: `plan` holds decisions, `decisions` makes
them, `groups` reads which objects count as one."""
