// ros2_control controller (Humble, Jazzy) around a policy of `rlservo compile`: add `ur5.c` to its library.
// Nothing in `update` allocates or waits.
#include <string>

#include "controller_interface/controller_interface.hpp"
#include "pluginlib/class_list_macros.hpp"
#include "ur5.h"

class PolicyController : public controller_interface::ControllerInterface {
 public:
  controller_interface::CallbackReturn on_init() override { return controller_interface::CallbackReturn::SUCCESS; }

  controller_interface::InterfaceConfiguration command_interface_configuration() const override {
    return interfaces("action", UR5_ACTION_SIZE);
  }

  // Your broadcaster exports the observation's elements, in the order of the header.
  controller_interface::InterfaceConfiguration state_interface_configuration() const override {
    return interfaces("observation", UR5_OBS_SIZE);
  }

  controller_interface::CallbackReturn on_activate(const rclcpp_lifecycle::State &) override {
    ur5_reset(&state_);
    return controller_interface::CallbackReturn::SUCCESS;
  }

  // The controller manager's update_rate for this controller is UR5_CONTROL_RATE_HZ.
  controller_interface::return_type update(const rclcpp::Time &, const rclcpp::Duration &) override {
    for (std::size_t i = 0; i < UR5_OBS_SIZE; i++)
      obs_.values[i] = static_cast<float>(state_interfaces_[i].get_value());
    if (UR5_REFUSED(ur5_act(&obs_, &state_, &action_)))
      return controller_interface::return_type::ERROR;
    for (std::size_t i = 0; i < UR5_ACTION_SIZE; i++)
      command_interfaces_[i].set_value(static_cast<double>(action_.values[i]));
    return controller_interface::return_type::OK;
  }

 private:
  static controller_interface::InterfaceConfiguration interfaces(const std::string & name, int count) {
    controller_interface::InterfaceConfiguration found;
    found.type = controller_interface::interface_configuration_type::INDIVIDUAL;
    for (int i = 0; i < count; i++) found.names.push_back("policy/" + name + "." + std::to_string(i));
    return found;
  }

  ur5_obs obs_{};
  ur5_state state_{};
  ur5_action action_{};
};

PLUGINLIB_EXPORT_CLASS(PolicyController, controller_interface::ControllerInterface)
