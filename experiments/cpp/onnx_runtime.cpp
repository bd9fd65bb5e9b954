// Run an exported program in ONNX Runtime.
//
//     scorer_onnx_runtime FOLDER [TOLERANCE]
//     scorer_onnx_runtime EXTRACTION SYSTEM QUERY.ppm CANDIDATE.ppm
//
// Prints the outputs and the largest difference from those in the folder. Exits with 1 if the difference is above the
// tolerance. With two folders: prints the scores of an image pair.

#include <onnxruntime_cxx_api.h>

#include "arrays.h"

Outputs run(const std::string& folder, const Inputs& array_of) {
  Ort::Env env(ORT_LOGGING_LEVEL_ERROR, "exported_scorer");
  Ort::Session session(env, (folder + "/program.onnx").c_str(), Ort::SessionOptions{});
  Ort::AllocatorWithDefaultOptions allocator;
  const auto memory = Ort::MemoryInfo::CreateCpu(OrtArenaAllocator, OrtMemTypeDefault);

  std::vector<std::string> names;
  std::vector<Bytes> arrays;  // the tensors use their memory
  std::vector<Ort::Value> inputs;
  for (size_t i = 0; i < session.GetInputCount(); ++i) {
    names.emplace_back(session.GetInputNameAllocated(i, allocator).get());
    arrays.push_back(array_of(names.back()));
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

  Outputs results;
  for (size_t i = 0; i < outputs.size(); ++i) {
    const auto tensor = outputs[i].GetTensorTypeAndShapeInfo();
    const bool is_mask = tensor.GetElementType() == ONNX_TENSOR_ELEMENT_DATA_TYPE_BOOL;
    const auto* bytes = outputs[i].GetTensorData<char>();
    const size_t length = tensor.GetElementCount() * (is_mask ? 1 : sizeof(float));
    results.emplace_back(names[num_inputs + i], Bytes(bytes, bytes + length));
  }
  return results;
}

int main(int argc, char** argv) { return run_example(argc, argv, run); }
