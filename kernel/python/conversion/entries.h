// Entries of a Python dictionary as arrays of the kernel; std::invalid_argument with the key if one is too long.
#ifndef DBK_ENTRIES_H
#define DBK_ENTRIES_H

#include <vector>

#include "conversion/buffers.h"

inline std::vector<double> values(const nanobind::dict &d, const char *key) {
  const Array a = nanobind::cast<Array>(d[key]);
  return {a.data(), a.data() + a.size()};
}

template <typename Number>
size_t fill(const nanobind::dict &d, const char *key, Number *to, size_t max_count) {
  const std::vector<double> v = values(d, key);
  expect(v.size() <= max_count, key);
  for (size_t i = 0; i < v.size(); ++i) { to[i] = static_cast<Number>(v[i]); }
  return v.size();
}

#endif
