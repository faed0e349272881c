// What the controller of examples/compiled uses of pluginlib.
#pragma once
#define PLUGINLIB_EXPORT_CLASS(kind, base) static_assert(sizeof(kind) >= sizeof(base), "a " #base);
