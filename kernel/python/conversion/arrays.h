// Arrays that enter and leave a step: float64 arrays are read in place through the C interface of numpy, which takes
// about ten nanoseconds; the buffer protocol takes about a hundred.
#ifndef DBK_ARRAYS_H
#define DBK_ARRAYS_H

#include <nanobind/nanobind.h>

#define NPY_NO_DEPRECATED_API NPY_2_0_API_VERSION
#include <numpy/arrayobject.h>

#include <stdexcept>

#include "conversion/result_pool.h"
#include "dbk/dbk.h"

// true for an array of integers or real numbers; text, truth values, complex numbers and objects are no measurements
inline bool is_real(PyArrayObject *array) {
  const int type = PyArray_TYPE(array);
  return PyTypeNum_ISINTEGER(type) || PyTypeNum_ISFLOAT(type);
}

// `count` numbers as a float64 array: the object itself if it already is one, else a copy; std::invalid_argument if the
// conversion fails
inline nanobind::object vector(nanobind::handle from, size_t count, const char *what) {
  auto *array = reinterpret_cast<PyArrayObject *>(from.ptr());
  nanobind::object kept = nanobind::borrow(from);
  if (!PyArray_Check(from.ptr()) || PyArray_TYPE(array) != NPY_DOUBLE || !PyArray_ISCARRAY_RO(array)) {
    const nanobind::object any = nanobind::steal(PyArray_FROM_O(from.ptr()));
    if (any.is_valid() && is_real(reinterpret_cast<PyArrayObject *>(any.ptr()))) {
      kept = nanobind::steal(PyArray_FROM_OTF(any.ptr(), NPY_DOUBLE, NPY_ARRAY_IN_ARRAY | NPY_ARRAY_FORCECAST));
    } else {
      kept = nanobind::object();
    }
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

// copies `count` numbers to `to`; returns the array that was read
inline nanobind::object read_vector(nanobind::handle from, dbk_real *to, size_t count, const char *what) {
  nanobind::object kept = vector(from, count, what);
  const auto *data = static_cast<const double *>(PyArray_DATA(reinterpret_cast<PyArrayObject *>(kept.ptr())));
  for (size_t i = 0; i < count; ++i) { to[i] = static_cast<dbk_real>(data[i]); }
  return kept;
}

// one real number; std::invalid_argument for text, truth values, complex numbers and numbers beyond float64
inline double read_number(nanobind::handle from, const char *what) {
  if (PyFloat_Check(from.ptr())) { return PyFloat_AsDouble(from.ptr()); }
  auto *array = reinterpret_cast<PyArrayObject *>(from.ptr());
  const bool real = (PyLong_Check(from.ptr()) && !PyBool_Check(from.ptr())) || PyArray_IsScalar(from.ptr(), Integer) ||
                    PyArray_IsScalar(from.ptr(), Floating) ||
                    (PyArray_Check(from.ptr()) && PyArray_NDIM(array) == 0 && is_real(array));
  const double value = real ? PyFloat_AsDouble(from.ptr()) : 0.0;
  if (!real || PyErr_Occurred()) {
    PyErr_Clear();
    throw std::invalid_argument(what);
  }
  return value;
}

// checks that a pooled float64 array (count,) is unchanged: a former owner can have reshaped it or made it read-only
inline bool is_reusable(nanobind::handle kept, size_t count) {
  auto *array = reinterpret_cast<PyArrayObject *>(kept.ptr());
  return PyArray_TYPE(array) == NPY_DOUBLE && PyArray_ISCARRAY(array) && PyArray_NDIM(array) == 1 &&
         PyArray_DIM(array, 0) == static_cast<npy_intp>(count);
}

// a float64 array of `count` numbers, new or from the pool
inline nanobind::object make_array(const dbk_real *from, size_t count, ResultPool &pool) {
  nanobind::object &array = pool.array[pool.next ^= 1];
  if (!array.is_valid() || Py_REFCNT(array.ptr()) != 1 || !is_reusable(array, count)) {
    npy_intp size = static_cast<npy_intp>(count);
    array = nanobind::steal(PyArray_SimpleNew(1, &size, NPY_DOUBLE));
    if (!array.is_valid()) { throw nanobind::python_error(); }
  }
  auto *data = static_cast<double *>(PyArray_DATA(reinterpret_cast<PyArrayObject *>(array.ptr())));
  for (size_t i = 0; i < count; ++i) { data[i] = static_cast<double>(from[i]); }
  return array;
}

#endif
