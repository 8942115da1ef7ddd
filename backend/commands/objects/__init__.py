"""Commands on the objects of a reconstruction: mesh, edit, export, film."""
