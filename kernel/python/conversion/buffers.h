// Arrays that Python passes as input or as output buffers, and their validation.
#ifndef DBK_BUFFERS_H
#define DBK_BUFFERS_H

#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>

#include <stdexcept>

#include "dbk/dbk.h"

// the name of this build: the structures of different builds have different sizes
#define DBK_QUOTE(name) #name
#define DBK_SPELLED(name) DBK_QUOTE(name)
constexpr const char *kBuild = DBK_SPELLED(DBK_MODULE);

using Array = nanobind::ndarray<const double, nanobind::c_contig, nanobind::device::cpu>;
using Out = nanobind::ndarray<double, nanobind::c_contig, nanobind::device::cpu>;
using Bytes = nanobind::ndarray<int8_t, nanobind::c_contig, nanobind::device::cpu>;
using Integers = nanobind::ndarray<int32_t, nanobind::c_contig, nanobind::device::cpu>;

inline void expect(bool valid, const char *what) {
  if (!valid) { throw std::invalid_argument(what); }
}

inline void copy(const Array &from, dbk_real *to, size_t count, const char *what) {
  expect(from.size() == count, what);
  for (size_t i = 0; i < count; ++i) { to[i] = static_cast<dbk_real>(from.data()[i]); }
}

#endif
