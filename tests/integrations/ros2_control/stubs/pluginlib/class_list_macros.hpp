// Stub: a plugin must derive from its base class and have a default constructor.
#ifndef STUB_PLUGINLIB_CLASS_LIST_MACROS_HPP_
#define STUB_PLUGINLIB_CLASS_LIST_MACROS_HPP_

#include <type_traits>

#define PLUGINLIB_EXPORT_CLASS(kind, base)                                                       \
  static_assert(std::is_base_of<base, kind>::value && std::is_default_constructible<kind>::value, \
                "a plugin derives from its base class");

#endif
