// Run an exported scorer in ONNX Runtime, and compare its outputs with those in the folder.
//
//     scorer_onnx_runtime FOLDER [TOLERANCE]
//
// Prints the scores and the largest difference. Exits with 1 if the difference is above the tolerance.

#include <onnxruntime_cxx_api.h>

#include "arrays.h"

float run(const std::string& folder) {
  Ort::Env env(ORT_LOGGING_LEVEL_ERROR, "exported_scorer");
  Ort::Session session(env, (folder + "/program.onnx").c_str(), Ort::SessionOptions{});
  Ort::AllocatorWithDefaultOptions allocator;
  const auto memory = Ort::MemoryInfo::CreateCpu(OrtArenaAllocator, OrtMemTypeDefault);

  std::vector<std::string> names;
  std::vector<std::vector<char>> arrays;  // the tensors use their memory
  std::vector<Ort::Value> inputs;
  for (size_t i = 0; i < session.GetInputCount(); ++i) {
    names.emplace_back(session.GetInputNameAllocated(i, allocator).get());
    arrays.push_back(read_array(folder + "/check/" + names.back() + ".npy"));
    const auto type = session.GetInputTypeInfo(i);
    const auto tensor = type.GetTensorTypeAndShapeInfo();
    const auto shape = tensor.GetShape();
    inputs.push_back(Ort::Value::CreateTensor(memory, arrays.back().data(), arrays.back().size(), shape.data(),
                                              shape.size(), tensor.GetElementType()));
  }
  const size_t num_inputs = names.size();
  for (size_t i = 0; i < session.GetOutputCount(); ++i)
    names.emplace_back(session.GetOutputNameAllocated(i, allocator).get());
  std::vector<const char*> pointers;
  for (const auto& name : names) pointers.push_back(name.c_str());

  const auto outputs = session.Run(Ort::RunOptions{}, pointers.data(), inputs.data(), num_inputs,
                                   pointers.data() + num_inputs, names.size() - num_inputs);

  float largest = 0;
  for (size_t i = 0; i < outputs.size(); ++i) {
    const size_t count = outputs[i].GetTensorTypeAndShapeInfo().GetElementCount();
    largest = std::max(largest, compare(folder, names[num_inputs + i], outputs[i].GetTensorData<float>(), count));
  }
  return largest;
}

int main(int argc, char** argv) { return run_example(argc, argv, run); }
