#include "dualbrain_ros2_control/safety_filter_controller.hpp"

#include <algorithm>
#include <cmath>
#include <limits>
#include <stdexcept>

#include "pluginlib/class_list_macros.hpp"
#include "rclcpp/logging.hpp"

namespace dualbrain_ros2_control {

using controller_interface::CallbackReturn;
using controller_interface::InterfaceConfiguration;
using controller_interface::interface_configuration_type;
using controller_interface::return_type;

namespace {

constexpr double kUnknown = std::numeric_limits<double>::quiet_NaN();
constexpr double kRateTolerance = 0.01;  // share by which the update rate may differ from that of the tables

InterfaceConfiguration individual(const std::vector<std::string> &joints, const std::vector<std::string> &kinds) {
  InterfaceConfiguration configuration;
  configuration.type = interface_configuration_type::INDIVIDUAL;
  for (const std::string &kind : kinds) {
    for (const std::string &joint : joints) { configuration.names.push_back(joint + "/" + kind); }
  }
  return configuration;
}

}  // namespace

CallbackReturn SafetyFilterController::on_init() {
  auto_declare<std::string>("tables", "");
  auto_declare<std::vector<std::string>>("joints", std::vector<std::string>());
  return CallbackReturn::SUCCESS;
}

CallbackReturn SafetyFilterController::on_configure(const rclcpp_lifecycle::State &) {
  try {
    tables_ = read_kernel_tables(get_node()->get_parameter("tables").as_string());
  } catch (const std::runtime_error &error) {
    RCLCPP_ERROR(get_node()->get_logger(), "%s", error.what());
    return CallbackReturn::ERROR;
  }
  joints_ = get_node()->get_parameter("joints").as_string_array();
  if (joints_.empty()) { joints_ = tables_.joints; }
  if (joints_.size() != tables_.joints.size()) {
    RCLCPP_ERROR(get_node()->get_logger(),
                 "The parameter `joints` has %zu names, the tables have %zu joints. Name all joints in the order of "
                 "the robot model",
                 joints_.size(), tables_.joints.size());
    return CallbackReturn::ERROR;
  }
  const double rate = static_cast<double>(get_update_rate()), period = static_cast<double>(tables_.model->period);
  if (rate > 0.0 && std::abs(rate * period - 1.0) > kRateTolerance) {
    RCLCPP_ERROR(get_node()->get_logger(),
                 "The update rate is %g Hz, the tables are for %g Hz. Write them with `--period %g`", rate,
                 1.0 / period, 1.0 / rate);
    return CallbackReturn::ERROR;
  }
  context_ = std::make_unique<dbk_ctx>();
  reference_interfaces_.assign(joints_.size(), kUnknown);
  return CallbackReturn::SUCCESS;
}

// the memory of the filter begins at the measured velocity
CallbackReturn SafetyFilterController::on_activate(const rclcpp_lifecycle::State &) {
  std::fill(reference_interfaces_.begin(), reference_interfaces_.end(), kUnknown);
  dbk_init(context_.get());
  read_state();
  for (size_t k = 0; k < joints_.size(); ++k) {
    const dbk_real velocity = std::isfinite(in_.v[k]) ? in_.v[k] : dbk_real(0);
    context_->u_prev[k] = context_->u_nom_prev[k] = velocity;
  }
  return CallbackReturn::SUCCESS;
}

CallbackReturn SafetyFilterController::on_deactivate(const rclcpp_lifecycle::State &) {
  const dbk_real zero[DBK_MAX_DOF] = {};
  return write_commands(zero) ? CallbackReturn::SUCCESS : CallbackReturn::ERROR;
}

InterfaceConfiguration SafetyFilterController::command_interface_configuration() const {
  return individual(joints_, {"velocity"});
}

InterfaceConfiguration SafetyFilterController::state_interface_configuration() const {
  return individual(joints_, {"position", "velocity"});
}

std::vector<hardware_interface::CommandInterface> SafetyFilterController::on_export_reference_interfaces() {
  std::vector<hardware_interface::CommandInterface> references;
  for (size_t k = 0; k < joints_.size(); ++k) {
    references.emplace_back(get_node()->get_name(), joints_[k] + "/velocity", &reference_interfaces_[k]);
  }
  return references;
}

bool SafetyFilterController::on_set_chained_mode(bool) {
  std::fill(reference_interfaces_.begin(), reference_interfaces_.end(), kUnknown);
  return true;
}

// without a controller before it there is no reference
return_type SafetyFilterController::update_reference_from_subscribers(const rclcpp::Time &, const rclcpp::Duration &) {
  std::fill(reference_interfaces_.begin(), reference_interfaces_.end(), kUnknown);
  return return_type::OK;
}

return_type SafetyFilterController::update_and_write_commands(const rclcpp::Time &, const rclcpp::Duration &) {
  read_state();
  read_references();
  dbk_step(tables_.model.get(), tables_.scene.get(), context_.get(), &in_, &out_);
  return write_commands(out_.u) ? return_type::OK : return_type::ERROR;
}

// positions, then velocities; the kernel brakes at a value that is not finite
void SafetyFilterController::read_state() {
  const size_t n = joints_.size();
  for (size_t k = 0; k < n; ++k) {
    in_.q[k] = static_cast<dbk_real>(state_interfaces_[k].get_optional().value_or(kUnknown));
    in_.v[k] = static_cast<dbk_real>(state_interfaces_[n + k].get_optional().value_or(kUnknown));
  }
}

// all zero if one is not finite: a part of a motion is another motion
void SafetyFilterController::read_references() {
  const size_t n = joints_.size();
  const auto finite = [](double value) { return std::isfinite(static_cast<dbk_real>(value)); };
  const bool usable = std::all_of(reference_interfaces_.begin(), reference_interfaces_.end(), finite);
  for (size_t k = 0; k < n; ++k) { in_.u_nom[k] = usable ? static_cast<dbk_real>(reference_interfaces_[k]) : 0; }
}

bool SafetyFilterController::write_commands(const dbk_real *u) {
  bool written = true;
  for (size_t k = 0; k < joints_.size(); ++k) {
    written = command_interfaces_[k].set_value(static_cast<double>(u[k])) && written;
  }
  return written;
}

}  // namespace dualbrain_ros2_control

PLUGINLIB_EXPORT_CLASS(dualbrain_ros2_control::SafetyFilterController,
                       controller_interface::ChainableControllerInterface)
