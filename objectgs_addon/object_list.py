# SPDX-License-Identifier: GPL-3.0-or-later
"""The list of objects: colour, name, counts, visibility; filtered by name."""

import bpy

from . import object_edits, visibility


class ObjectList(bpy.types.UIList):
    """Rows of `ObjectItem`."""

    bl_idname = "OBJECTGS_UL_objects"
    layers = {}
    """Object ID -> layer collection: looked for once a redraw, since every row asks."""

    def draw_item(self, _context, layout, _properties, item, _icon, _active, _property, _index=0, _flag=0):
        row = layout.row(align=True)
        swatch = row.row()
        swatch.ui_units_x = 0.8
        swatch.prop(item, "colour", text="")
        name = row.row()
        name.active = item.chosen and not item.is_merged and not item.removed
        name.prop(item, "name", text="", emboss=False)
        numbers = row.row()
        numbers.alignment = "RIGHT"
        numbers.active = False
        numbers.label(text=_count(item))
        row.prop(item, "chosen", text="", icon="CHECKBOX_HLT" if item.chosen else "CHECKBOX_DEHLT", emboss=False)
        layer = ObjectList.layers.get(object_edits.from_stored(item.object_id))
        if item.removed:
            row.operator("objectgs.restore_object", text="", icon="TRASH", emboss=False).object = str(
                object_edits.from_stored(item.object_id))
        elif layer is None:
            row.label(text="", icon="LINKED" if item.is_merged else "BLANK1")
        else:
            row.prop(layer, "hide_viewport", text="", emboss=False,
                     icon="HIDE_ON" if layer.hide_viewport else "HIDE_OFF")

    def filter_items(self, context, properties, name):
        ObjectList.layers = visibility.object_layers(context.view_layer, properties.id_data)
        items = getattr(properties, name)
        helpers = bpy.types.UI_UL_list
        wanted = helpers.filter_items_by_name(self.filter_name, self.bitflag_filter_item, items, "name") \
            if self.filter_name else []
        order = helpers.sort_items_by_name(items, "name") if self.use_filter_sort_alpha else []
        return wanted, order


def describe(item, properties) -> str:
    """A row's numbers in words."""
    object_id = object_edits.from_stored(item.object_id)
    words = [f"ID {object_id}", f"{item.points:,} points"]
    if item.splats:
        words.append(f"{item.splats:,} splats")
    if item.faces:
        words.append(f"{item.faces:,} faces")
    if item.removed:
        words.append("removed")
    if item.is_merged:
        into = next((other.name for other in properties.objects if other.object_id == item.merged_into), "?")
        words.append(f"part of {into}")
    return ", ".join(words)


def _count(item) -> str:
    """Splats, or points where there are none yet."""
    return "" if item.is_merged else _short(item.splats or item.points)


def _short(count: int) -> str:
    return f"{count:,}" if count < 10_000 else f"{count / 1000:,.0f}k" if count < 1_000_000 else f"{count / 1e6:.1f}M"


def register():
    bpy.utils.register_class(ObjectList)


def unregister():
    bpy.utils.unregister_class(ObjectList)
