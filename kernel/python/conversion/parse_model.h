// Conversion of a robot and of obstacles from the Python representation to the kernel's structures.
#ifndef DBK_PARSE_MODEL_H
#define DBK_PARSE_MODEL_H

#include <nanobind/nanobind.h>

#include <memory>

#include "dbk/dbk.h"

// std::invalid_argument if an array has a wrong size
void parse_model(const nanobind::dict &d, dbk_model *model);

// the model with the spheres that cover every finger opening ("hull_spheres"); null if there are none
std::unique_ptr<dbk_model> parse_hull_model(const nanobind::dict &d, const dbk_model &model);

// one row of the obstacle table, in the order of the fields of dbk_obstacle
constexpr size_t kObstacle = 29;
void parse_obstacle(const double *row, dbk_obstacle *o);

#endif
