// Chainable controller of ros2_control that replaces joint velocities by the closest safe ones. Not tested on ROS.
#ifndef DUALBRAIN_ROS2_CONTROL__SAFETY_FILTER_CONTROLLER_HPP_
#define DUALBRAIN_ROS2_CONTROL__SAFETY_FILTER_CONTROLLER_HPP_

#include <memory>
#include <string>
#include <vector>

#include "controller_interface/chainable_controller_interface.hpp"
#include "dbk/dbk.h"
#include "dualbrain_ros2_control/kernel_tables.hpp"

namespace dualbrain_ros2_control {

// Parameters: `tables`, the file of `dualbrain ros2 tables`; `joints`, the ROS names of the joints in the order of the
// robot model, by default those of the tables.
//
// References: JOINT/velocity [rad/s] of every joint. State interfaces: JOINT/position and JOINT/velocity. Command
// interfaces: JOINT/velocity. One kernel step per update; the update rate must be that of the tables. The arm comes to
// rest, within its acceleration limits, while a reference or a state is not finite, and outside the chained mode.
class SafetyFilterController : public controller_interface::ChainableControllerInterface {
 public:
  controller_interface::CallbackReturn on_init() override;
  controller_interface::CallbackReturn on_configure(const rclcpp_lifecycle::State &previous) override;
  controller_interface::CallbackReturn on_activate(const rclcpp_lifecycle::State &previous) override;
  controller_interface::CallbackReturn on_deactivate(const rclcpp_lifecycle::State &previous) override;
  controller_interface::InterfaceConfiguration command_interface_configuration() const override;
  controller_interface::InterfaceConfiguration state_interface_configuration() const override;

 protected:
  std::vector<hardware_interface::CommandInterface> on_export_reference_interfaces() override;
  bool on_set_chained_mode(bool chained_mode) override;
  controller_interface::return_type update_reference_from_subscribers(const rclcpp::Time &time,
                                                                      const rclcpp::Duration &period) override;
  controller_interface::return_type update_and_write_commands(const rclcpp::Time &time,
                                                              const rclcpp::Duration &period) override;

 private:
  void read_state();
  void read_references();
  bool write_commands(const dbk_real *u);

  std::vector<std::string> joints_;
  KernelTables tables_;
  std::unique_ptr<dbk_ctx> context_;
  dbk_in in_{};
  dbk_out out_{};
};

}  // namespace dualbrain_ros2_control

#endif
