// Stub of controller_interface::ChainableControllerInterface (Jazzy and later): the parts that the controller uses.
#ifndef STUB_CHAINABLE_CONTROLLER_INTERFACE_HPP_
#define STUB_CHAINABLE_CONTROLLER_INTERFACE_HPP_

#include <memory>
#include <string>
#include <vector>

#include "hardware_interface/handle.hpp"
#include "rclcpp/rclcpp.hpp"
#include "rclcpp_lifecycle/state.hpp"

namespace controller_interface {

enum class return_type { OK, ERROR };
enum class CallbackReturn { SUCCESS, FAILURE, ERROR };
enum class interface_configuration_type { ALL, INDIVIDUAL, NONE };

struct InterfaceConfiguration {
  interface_configuration_type type = interface_configuration_type::NONE;
  std::vector<std::string> names;
};

class ChainableControllerInterface {
 public:
  virtual ~ChainableControllerInterface() = default;
  virtual CallbackReturn on_init() = 0;
  virtual CallbackReturn on_configure(const rclcpp_lifecycle::State &previous) = 0;
  virtual CallbackReturn on_activate(const rclcpp_lifecycle::State &previous) = 0;
  virtual CallbackReturn on_deactivate(const rclcpp_lifecycle::State &previous) = 0;
  virtual InterfaceConfiguration command_interface_configuration() const = 0;
  virtual InterfaceConfiguration state_interface_configuration() const = 0;

  // what the controller manager does: claim interfaces, export references, chain, update
  void claim() {
    exported = on_export_reference_interfaces();
    state_interfaces_.resize(state_interface_configuration().names.size());
    command_interfaces_.resize(command_interface_configuration().names.size());
  }
  bool set_chained_mode(bool chained) { return on_set_chained_mode(chained_ = chained); }
  return_type update(const rclcpp::Time &time, const rclcpp::Duration &period) {
    if (!chained_ && update_reference_from_subscribers(time, period) != return_type::OK) { return return_type::ERROR; }
    return update_and_write_commands(time, period);
  }
  std::shared_ptr<rclcpp::Node> get_node() const { return node_; }
  unsigned int get_update_rate() const { return update_rate; }

  std::vector<hardware_interface::CommandInterface> exported;
  std::vector<hardware_interface::LoanedStateInterface> state_interfaces_;
  std::vector<hardware_interface::LoanedCommandInterface> command_interfaces_;
  unsigned int update_rate = 0;

 protected:
  virtual std::vector<hardware_interface::CommandInterface> on_export_reference_interfaces() = 0;
  virtual bool on_set_chained_mode(bool chained_mode) = 0;
  virtual return_type update_reference_from_subscribers(const rclcpp::Time &time, const rclcpp::Duration &period) = 0;
  virtual return_type update_and_write_commands(const rclcpp::Time &time, const rclcpp::Duration &period) = 0;

  template <typename T>
  void auto_declare(const std::string &name, const T &value) {
    node_->declare(name, value);
  }

  std::vector<double> reference_interfaces_;

 private:
  std::shared_ptr<rclcpp::Node> node_ = std::make_shared<rclcpp::Node>();
  bool chained_ = false;
};

}  // namespace controller_interface

#endif
