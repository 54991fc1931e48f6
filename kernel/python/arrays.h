// Arrays of numbers that come in and go out of a step: float64 arrays are read in place through numpy's own interface,
// which takes some ten nanoseconds where the buffer protocol takes some hundred.
#ifndef DBK_ARRAYS_H
#define DBK_ARRAYS_H

#include <nanobind/nanobind.h>

#define NPY_NO_DEPRECATED_API NPY_2_0_API_VERSION
#include <numpy/arrayobject.h>

#include <stdexcept>

#include "dbk/dbk.h"
#include "spares.h"

// (count,) numbers as a float64 array: itself where it is one, else a copy; std::invalid_argument where it cannot be one
inline nanobind::object vector(nanobind::handle from, size_t count, const char *what) {
  auto *array = reinterpret_cast<PyArrayObject *>(from.ptr());
  nanobind::object kept = nanobind::borrow(from);
  if (!PyArray_Check(from.ptr()) || PyArray_TYPE(array) != NPY_DOUBLE || !PyArray_ISCARRAY_RO(array)) {
    kept = nanobind::steal(PyArray_FROM_OTF(from.ptr(), NPY_DOUBLE, NPY_ARRAY_IN_ARRAY));
    if (!kept.is_valid()) {
      PyErr_Clear();
      throw std::invalid_argument(what);
    }
    array = reinterpret_cast<PyArrayObject *>(kept.ptr());
  }
  if (PyArray_NDIM(array) != 1 || PyArray_DIM(array, 0) != static_cast<npy_intp>(count)) {
    throw std::invalid_argument(what);
  }
  return kept;
}

inline nanobind::object take(nanobind::handle from, dbk_real *to, size_t count, const char *what) {
  nanobind::object kept = vector(from, count, what);
  const auto *data = static_cast<const double *>(PyArray_DATA(reinterpret_cast<PyArrayObject *>(kept.ptr())));
  for (size_t i = 0; i < count; ++i) { to[i] = static_cast<dbk_real>(data[i]); }
  return kept;
}

// whether a float64 array (count,) made here is still one: who held it may have given it another shape, or locked it
inline bool as_made(nanobind::handle kept, size_t count) {
  auto *array = reinterpret_cast<PyArrayObject *>(kept.ptr());
  return PyArray_TYPE(array) == NPY_DOUBLE && PyArray_ISCARRAY(array) && PyArray_NDIM(array) == 1 &&
         PyArray_DIM(array, 0) == static_cast<npy_intp>(count);
}

// a float64 array of `count` numbers, new or spare
inline nanobind::object give(const dbk_real *from, size_t count, Spares &spares) {
  nanobind::object &mine = spares.array[spares.turn ^= 1];
  if (!mine.is_valid() || Py_REFCNT(mine.ptr()) != 1 || !as_made(mine, count)) {
    npy_intp size = static_cast<npy_intp>(count);
    mine = nanobind::steal(PyArray_SimpleNew(1, &size, NPY_DOUBLE));
    if (!mine.is_valid()) { throw nanobind::python_error(); }
  }
  auto *data = static_cast<double *>(PyArray_DATA(reinterpret_cast<PyArrayObject *>(mine.ptr())));
  for (size_t i = 0; i < count; ++i) { data[i] = static_cast<double>(from[i]); }
  return mine;
}

#endif
