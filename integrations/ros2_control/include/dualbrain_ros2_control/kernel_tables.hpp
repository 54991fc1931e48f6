// Robot model and obstacles of the kernel, read from the file that `dualbrain ros2 tables` writes.
#ifndef DUALBRAIN_ROS2_CONTROL__KERNEL_TABLES_HPP_
#define DUALBRAIN_ROS2_CONTROL__KERNEL_TABLES_HPP_

#include <memory>
#include <string>
#include <vector>

#include "dbk/dbk.h"

namespace dualbrain_ros2_control {

struct KernelTables {
  std::vector<std::string> joints;
  std::unique_ptr<dbk_model> model;  // prepared
  std::unique_ptr<dbk_scene> scene;  // prepared
};

// Reads the file at `path`. Throws std::runtime_error, with cause and remedy, if it is no such file or does not fit the
// capacity of this build of the kernel. Allocates memory: call it outside the control loop.
KernelTables read_kernel_tables(const std::string &path);

}  // namespace dualbrain_ros2_control

#endif
